"""Finished runs beside each other: their methods in one table, and error against time."""
