"""Volumes carried between lattices: the world's grid and the cameras' frusta."""
