"""Odometries of other libraries (peers), behind this project's interface and driver."""
