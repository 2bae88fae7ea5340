"""Where a scene can have anything in it, told from its views."""
