"""All of mvrecon's operators of torch, `torch.ops.mvrecon`; importing this file makes them known,
as `torch.export.load` needs for a program that was exported.
"""

from mvrecon.kernels import voxels, warps
from mvrecon.kernels.rays import ops

__all__ = ["ops", "voxels", "warps"]
