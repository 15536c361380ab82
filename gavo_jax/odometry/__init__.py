"""From frames to a trajectory: the program for a frame, who aligns it, the driver, a whole run."""
