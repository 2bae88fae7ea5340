"""Calibration of a rig: from views of a known marker phantom, or from the measured views alone."""
