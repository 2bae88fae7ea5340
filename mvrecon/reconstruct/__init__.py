"""Classical iterative reconstruction with any linear operator: SIRT, MLEM, OSEM."""
