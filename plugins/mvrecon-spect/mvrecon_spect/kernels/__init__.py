"""Footprints of voxels behind pinholes: the operators, their reference, and their kernels."""
