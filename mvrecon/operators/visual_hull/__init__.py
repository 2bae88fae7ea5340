"""The visual hull: the voxels that may be non-zero, computed from the views."""
