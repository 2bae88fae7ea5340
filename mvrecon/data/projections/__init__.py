"""Measured views on disk: read view by view, corrected to line integrals, and written."""
