"""DiffDRR: Siddon's method and trilinear sampling as torch operations
(https://github.com/eigenvivek/DiffDRR).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Traced, choice, load
from mvrecon_peers.frame import chords, near

#: Samples in one call on a GPU, which bounds the memory: a sample takes some 50 bytes.
SAMPLES = 2**27
#: Added to a ray's direction (in voxels) lest it be divided by zero; DiffDRR's own 1e-8 is seen in
#: float64, and what is much less would take the crossings of planes along a ray, which lie far
#: away, out of the range of integers.
EPS = 1.1e-16
#: Rays along faces between voxels are moved off by so many roundings, or DiffDRR gives them to the
#: even voxel.
NUDGE = 4


def require_whole(box: Grid, rig: Cameras) -> None:
    """Raise ValueError if a ray that comes near the box starts or ends inside of it, or between it
    and its own line.
    """
    first, last = near(box, *rig.rays())
    enter, leave = chords(box, first.detach(), last.detach())
    cut = (enter < leave) & ((enter < -1e-9) | (leave > 1 + 1e-9))
    if cut.any():
        raise ValueError(
            f"DiffDRR's Siddon follows whole lines, so none may start or end in the box, got "
            f"{int(cut.sum())} of "
            f"{cut.numel()} rays that do; method 'trilinear' takes them"
        )


class Diffdrr(Traced):
    """DiffDRR's renderers, on any central or parallel rig.

    Matched adjoint and gradients, in the pose too, by autograd. Siddon follows whole lines, so that
    no ray may start or end in the box.

    Known of version 0.6.1's trilinear renderer: it cuts its samples off at the box, half a voxel
    short of where the kernel ends, so that objects at the box's faces lose some; it counts n / (n -
    1) of a ray's length, 1.002 with 500 samples; and it spreads them over what all rays rendered
    together have in the box, so that a ray's value depends on the others, by some per cent where
    few samples are left to it.

    Args:
        grid: where the voxels lie.
        cameras: the rig.
        method: "siddon" or "trilinear".
        samples: of the trilinear method on a ray, from the first entry to the last exit of the rays
            rendered together.

    Raises:
        ValueError: an unknown method, a geometry that `framed` does not take, or, for Siddon, rays
            that start or end inside of the box.
        ImportError: DiffDRR is not installed.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "siddon", samples: int = 500):
        super().__init__(grid, cameras)
        self.method, self.samples = choice("method", method, ("siddon", "trilinear")), samples
        if method == "siddon":
            require_whole(self.box, self.rig)
        renderers = load("diffdrr.renderers", "diffdrr")
        self.renderer = (
            renderers.Siddon(eps=EPS) if method == "siddon" else renderers.Trilinear(eps=EPS)
        )

    def at_once(self, device: torch.device) -> int:
        """As many views as threads on a CPU, as memory allows on a GPU."""
        per_ray = sum(self.grid.shape) + 3 if self.method == "siddon" else self.samples
        rows, columns = self.cameras.shape
        fit = max(1, SAMPLES // (rows * columns * per_ray))
        return (
            super().at_once(device) if device.type == "cpu" else min(fit, super().at_once(device))
        )

    def render(
        self,
        volume: Float[Tensor, "d h w"],
        first: Float[Tensor, "k r 3"],
        last: Float[Tensor, "k r 3"],
    ) -> Float[Tensor, "k r"]:
        """DiffDRR's views: it takes volumes [x y z], rays in voxels, and their lengths in mm."""
        start, end = self.box.to_index(first), self.box.to_index(last)
        nudge = NUDGE * torch.finfo(first.dtype).eps * max(self.grid.shape)
        along = nudge * ((end - start).detach().abs() <= nudge)
        start, end = start + along, end + along
        length = (last - first).norm(dim=-1)[:, None]
        options = {} if self.method == "siddon" else {"n_points": self.samples}
        return self.renderer(volume.permute(2, 1, 0), start, end, length, **options)[:, 0]
