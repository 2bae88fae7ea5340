"""Published methods and networks for comparison, and a scene of breast-like slices."""
