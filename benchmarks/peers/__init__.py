"""Other programs, which anybody can build, beside thinmap on the same scans."""
