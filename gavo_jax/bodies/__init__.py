"""Bodies that move on their own: what of an image the camera's motion does not explain, and how that moves."""
