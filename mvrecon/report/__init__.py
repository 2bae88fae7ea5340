"""Figures of merit, tables, pictures."""
