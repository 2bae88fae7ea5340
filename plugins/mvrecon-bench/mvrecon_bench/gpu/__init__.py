"""Measurements of mvrecon on a GPU, and an emulated GPU."""
