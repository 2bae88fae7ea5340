"""Benchmarks (run time against error) and the stress plan for projectors, cameras, scenes, heads
and methods.
"""
