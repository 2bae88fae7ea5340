"""All of mvrecon's operators of torch, `torch.ops.mvrecon`; importing this file makes them known,
as `torch.export.load` needs for a program that was exported.
"""

from mvrecon.kernels.rays import attenuated_ops, ops
from mvrecon.kernels.voxels import ops as voxels
from mvrecon.kernels.warps import warp as warps

__all__ = ["attenuated_ops", "ops", "voxels", "warps"]
