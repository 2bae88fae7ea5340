"""The CPU's back end: numba's loops over rays, on torch's number of threads."""
