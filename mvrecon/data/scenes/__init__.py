"""Phantoms with closed-form line integrals."""
