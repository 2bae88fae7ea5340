"""Kernels of CUDA devices with a thread a voxel, a sample or a pixel, where those along rays have one a ray."""
