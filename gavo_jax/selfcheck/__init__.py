"""The compiled kernels against their equations in float64, at the sizes that are used."""
