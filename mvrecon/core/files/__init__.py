"""Files: written atomically, bounded and checked when read."""
