"""What a run leaves: files, figures, reports, and words on the screen."""
