"""The cameras of a device from a file, whoever wrote it."""
