"""Registries, parts, files: no tensors of the field."""
