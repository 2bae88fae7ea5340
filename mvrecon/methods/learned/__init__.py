"""Learned reconstruction methods."""
