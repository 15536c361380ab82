"""From two frames to a motion with its covariance and status."""
