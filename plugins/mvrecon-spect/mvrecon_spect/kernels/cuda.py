"""Footprints on CUDA devices, deterministic: a thread a few pixels gathers the voxels that reach
them, and a thread a voxel the pixels under its footprints.
"""

import math
from collections.abc import Sequence
from ctypes import c_int, c_void_p
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.kernels.cuda import driver, launch
from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon_spect.kernels.reference import OF_U, OF_V, OF_W

#: Numbers of a footprint in the table, as in `footprints.cu`; share of a device's memory for it.
ENTRY, SHARE = 8, 1 / 16
#: Pixels of a thread along u and v, as in `footprints.cu`; threads that occupy a device, for which
#: the slabs are divided, into so many parts at most.
TILE, THREADS, PARTS = 4, 2**18, 64


class Pinholes(driver.Packed):
    """Arguments of a kernel, as in `footprints.cu`."""

    _fields_ = [
        *((name, c_void_p) for name in ("rig", "typed", "origin", "transmission", "axes")),
        *((name, c_void_p) for name in ("table", "reach", "result")),
        ("shape", c_int * 3),
        ("detector", c_int * 2),
        *((name, c_int) for name in ("pinholes", "first", "here", "slabs", "volumes", "parts")),
    ]


FOOTPRINTS = launch.Source(
    "FOOTPRINTS_OF",
    ("footprint_table", "footprint_project", "footprint_backproject"),
    Pinholes,
    (*launch.BASE, Path(__file__).with_name("footprints.cu")),
)


class Call:
    """One call of an operator: its arguments, and the tensors to keep until its last launch.

    Args:
        values: volumes [n d h w] or views [n m v u].
        rig: the record of each pinhole, see `reference.project`.
        shape, detector: voxels (d, h, w), and rows and columns.
        transmission: share of photons that arrive, from each voxel to each pinhole, or None.
    """

    def __init__(
        self,
        values: Tensor,
        rig: Float[Tensor, "m c"],
        shape: Sequence[int],
        detector: Sequence[int],
        transmission: Float[Tensor, "m d h w"] | None,
    ):
        self.values = to_accumulation_dtype(values.detach()).contiguous()
        self.rig = launch.numbers_of(rig)
        real, passes = self.values.dtype, transmission
        if passes is not None:
            passes = passes.detach().to(real).contiguous()
        self.tensors = self.rig.to(real), passes
        self.variant = launch.Variant(FOOTPRINTS, real)
        self.packed = Pinholes().put(
            rig=self.rig,
            typed=self.tensors[0],
            origin=self.values,
            transmission=passes,
            shape=tuple(int(n) for n in shape[::-1]),
            detector=tuple(int(n) for n in detector[::-1]),
            pinholes=len(rig),
            volumes=len(values),
        )

    def start(self, name: str, threads: int, down: int) -> None:
        """Launch a kernel with `down` rows of so many threads."""
        blocks = launch.blocks(threads)
        launch.start(self.variant, name, self.packed, self.values, blocks, down)


def project(volume, rig, detector, transmission=None):
    """Counts of volumes; see `reference.project`."""
    count, *shape = volume.shape
    call = Call(volume, rig, shape, detector, transmission)
    x, many, voxels = call.values, len(rig), math.prod(shape)
    threads = math.prod(-(-pixels // TILE) for pixels in detector)
    bytes_ = voxels * ENTRY * x.element_size()
    at_once = max(1, min(int(SHARE * driver.memory_of(x.device)) // bytes_, many))
    parts = max(1, min(THREADS // max(1, many * threads), PARTS))
    table, axes = x.new_empty(at_once, voxels, ENTRY), _axes(call.rig, detector)
    reach = torch.zeros(many, max(shape), 2, dtype=torch.int32, device=x.device)
    views = x.new_empty(parts, count, many, *detector)
    call.packed.put(table=table, axes=axes, reach=reach, result=views)
    call.packed.put(slabs=max(shape), parts=parts)
    for first in range(0, many, at_once):
        here = min(at_once, many - first)
        call.packed.put(first=first, here=here)
        call.start("footprint_table", here * voxels, 1)
        call.start("footprint_project", here * threads, parts * count)
    return views.sum(dim=0)


def backproject(views, rig, size, transmission=None):
    """The exact transpose of `project`."""
    call = Call(views, rig, size, views.shape[2:], transmission)
    volumes = call.values.new_empty(len(views), *size)
    call.packed.put(result=volumes)
    call.start("footprint_backproject", math.prod(size), len(views))
    return volumes


def _axes(rig: Float[Tensor, "m c"], detector: Sequence[int]) -> Int[Tensor, " m"]:
    """The grid's axis (x, y, z) most along the ray of a detector's centre: it crosses the slabs.

    Computed once, as two kernels might round a tie differently.
    """
    to_u, to_v, to_w = (rig[:, some][:, :3] for some in (OF_U, OF_V, OF_W))
    v, u = ((n - 1) / 2 for n in detector)
    along = torch.linalg.cross(to_u - u * to_w, to_v - v * to_w)
    return along.abs().argmax(dim=1).int()
