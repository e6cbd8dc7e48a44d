"""The pose graph: keyframes, loop closure and optimization."""
