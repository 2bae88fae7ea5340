"""Benchmarks: run time, memory and error of projectors and methods."""
