"""Files, volumes, and training samples."""
