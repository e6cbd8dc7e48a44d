"""Scan matching with a local map, and a pose graph of keyframes with loop closure."""
