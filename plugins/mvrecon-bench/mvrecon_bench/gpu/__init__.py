"""Measurements of mvrecon on a GPU, and a stand-in for one."""
