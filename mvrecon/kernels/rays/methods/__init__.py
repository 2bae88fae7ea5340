"""What a ray does in one step, once for each method, for the loops of the CPU."""
