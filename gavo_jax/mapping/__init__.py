"""A map of keyframes: loops, a pose graph, and the way back after a loss."""
