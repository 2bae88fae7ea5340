"""Cameras: the canonical record, rigs, and conversions to other conventions."""
