"""Joining of two pieces of map whose relative place has been recognized."""
