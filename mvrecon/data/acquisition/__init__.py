"""What made the views: the projector on a finer grid, the detector, its photons and its noise."""
