"""Cameras: one canonical record, the rigs that fill it, conversions to other conventions."""
