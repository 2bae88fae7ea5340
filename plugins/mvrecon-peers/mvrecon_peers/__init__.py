"""Other libraries' projectors as projectors of mvrecon: RTK, nanodrr, DiffDRR, ASTRA, mbirtorch,
scikit-image.
"""
