"""Reconstruction from counts: methods, priors, corrections, bounds, and fits to point sources."""
