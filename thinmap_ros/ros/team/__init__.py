"""What robots that explore together send each other."""
