"""Other people's projectors as mvrecon projectors: RTK, nanodrr, DiffDRR, ASTRA, mbirtorch and
scikit-image.
"""
