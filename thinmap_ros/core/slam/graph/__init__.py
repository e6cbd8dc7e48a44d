"""The pose graph: keyframes, loop closures, and the poses that agree best with them."""
