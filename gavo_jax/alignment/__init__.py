"""Alignment of two frames: their motion with its covariance and status."""
