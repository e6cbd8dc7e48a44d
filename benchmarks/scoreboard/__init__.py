"""The scoreboard: real logs, the same made worse, and drives in generated buildings."""
