"""Footprints of voxels on pixels behind pinholes: the operators, their reference, and their kernels
on the CPU.
"""
