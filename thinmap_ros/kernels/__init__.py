"""Compiled kernels: rehearsed, told of, and their compiler put away."""
