"""Where frames come from: the sequence protocol and its implementations."""
