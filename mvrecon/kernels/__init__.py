"""Compiled kernels with references in plain torch."""
