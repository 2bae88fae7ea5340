"""Voxel by voxel: each looks up its own image in every view."""
