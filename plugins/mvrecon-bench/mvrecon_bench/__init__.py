"""Benchmarks (run time against error) and the stress plan for projectors, cameras, heads and
models.
"""
