"""Slow, obvious torch implementation of the paper's equations, and the authors' recorded numbers in warpslam's axes."""
