"""Kernels of CUDA devices that have a thread a voxel, a sample or a pixel."""
