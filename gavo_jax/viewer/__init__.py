"""Viewers of a run."""
