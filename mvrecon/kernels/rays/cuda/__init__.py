"""The back end of CUDA devices: numba's kernels, a thread a ray or a voxel."""
