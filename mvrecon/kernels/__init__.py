"""The arithmetic of one ray: a torch oracle and its compiled twin."""
