"""Live capture from cameras, which always delivers the newest frame."""
