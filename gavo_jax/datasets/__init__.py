"""Sources of frames: the sequence protocol and its implementations."""
