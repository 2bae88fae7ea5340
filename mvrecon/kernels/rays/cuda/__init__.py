"""CUDA back end: ray kernels in CUDA C++, with a thread a ray or voxel."""
