"""CUDA: compiling, keeping and launching kernels, and those with a thread a voxel or a sample."""
