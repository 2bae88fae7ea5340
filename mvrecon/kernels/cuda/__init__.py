"""CUDA: compiling, caching and launching kernels, and kernels with a thread a voxel or sample."""
