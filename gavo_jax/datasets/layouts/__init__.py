"""Folder layouts of datasets stored as image files."""
