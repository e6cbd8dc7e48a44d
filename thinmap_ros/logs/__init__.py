"""Recorded scans: bags and CARMEN logs, read, written, repaired and played."""
