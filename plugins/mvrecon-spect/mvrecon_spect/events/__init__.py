"""Data sets of random emission events on disk."""
