"""Data sets of random events on disk: truth, ideal views, counts and sinograms in HDF5 shards."""
