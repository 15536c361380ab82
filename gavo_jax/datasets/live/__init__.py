"""Frames as a device gives them, the newest first."""
