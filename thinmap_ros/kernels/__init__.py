"""Compiled kernels: warm-up, progress of compilation, memory of the compiler."""
