"""Published methods and networks to compare with, and a scene of breast-like slices."""
