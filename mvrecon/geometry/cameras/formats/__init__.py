"""Geometry files of other programs, converted from and to the canonical record of cameras."""
