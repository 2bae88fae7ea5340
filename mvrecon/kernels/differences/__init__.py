"""Finite differences of volumes: the steps of total variation."""
