"""What an exploration believes of its candidates: evidence, fitted model, missing area."""
