"""Solvers: one protocol, one loop, four methods."""
