"""CPU back end: numba loops over rays, on torch's number of threads."""
