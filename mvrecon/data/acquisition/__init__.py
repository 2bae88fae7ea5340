"""Simulated acquisition of views: the projector on a finer grid, detector, photons and noise."""
