"""Formats of logs, one file each: `FORMAT` of a module says which files it opens, and how."""
