"""Output of a run: files, figures, reports and terminal text."""
