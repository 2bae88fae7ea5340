"""The back end of CUDA devices: kernels along rays in CUDA C++, a thread a ray or a voxel."""
