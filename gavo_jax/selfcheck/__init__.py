"""Comparison of the compiled kernels with their equations in float64, at the sizes in use."""
