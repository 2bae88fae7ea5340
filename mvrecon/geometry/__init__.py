"""Pure geometry: rigid motions, grids, sampling, camera frusta."""
