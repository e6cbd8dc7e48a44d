"""Large messages, read from their serialized form."""
