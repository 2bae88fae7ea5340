"""Reconstruction from few views over a circle: networks on sinograms, on images, on both, and
unrolled iterations.
"""
