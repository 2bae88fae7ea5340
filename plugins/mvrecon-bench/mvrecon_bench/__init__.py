"""Benchmarks (run time and error) and the stress plan for projectors, cameras, scenes, heads and
methods.
"""
