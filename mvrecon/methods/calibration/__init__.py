"""Rig calibration from views of a known marker phantom, or from the measured views alone."""
