"""The photometric error E(ξ): losses, points, the error of a population, its derivatives, what is estimated for it."""
