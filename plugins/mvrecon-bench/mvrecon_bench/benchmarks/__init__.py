"""Measurements of what the parts cost and how wrong they are: run time against error."""
