"""From frames to a trajectory: the program for a frame, the aligners, the driver, a whole run."""
