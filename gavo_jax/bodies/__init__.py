"""Bodies that move on their own: which parts of an image the camera's motion does not explain, and how those move."""
