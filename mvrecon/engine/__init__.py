"""Training under Lightning, and the board."""
