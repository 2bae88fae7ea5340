"""Geometry files of other programs, read into and written from the canonical record of cameras."""
