"""Registries, parts, files; no field-specific tensors."""
