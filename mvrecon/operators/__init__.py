"""Linear operators between a volume and its views."""
