"""Ray kernels: projection, back-projection, and derivatives by the geometry."""
