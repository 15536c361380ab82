"""The photometric error E(ξ): losses, points, the error of a population, its derivatives, estimates from the data."""
