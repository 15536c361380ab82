"""Calibration from a recording's images: rolling shutter, delay of depth, unit of depth, and intrinsics."""
