"""What the nodes share: lifecycle, subscriptions, messages, parameters, diagnostics."""
