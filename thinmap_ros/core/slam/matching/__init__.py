"""Scans against a local map of cells."""
