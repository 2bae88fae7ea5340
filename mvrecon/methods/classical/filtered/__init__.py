"""Filtered back-projection: FBP of parallel and fan beams, FDK of cone beams."""
