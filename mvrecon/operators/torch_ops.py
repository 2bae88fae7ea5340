"""Registers all of mvrecon's torch operators, `torch.ops.mvrecon`; import it before
`torch.export.load` of an exported program.
"""

from mvrecon.kernels import voxels, warps
from mvrecon.kernels.rays import ops

__all__ = ["ops", "voxels", "warps"]
