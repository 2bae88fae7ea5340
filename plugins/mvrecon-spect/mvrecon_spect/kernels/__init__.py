"""Attenuated rays: the operators, their reference, and their kernels on the CPU and in CUDA C++."""
