"""Figures of merit of emission volumes: contrast, resolution, the polar map, bias and variance."""
