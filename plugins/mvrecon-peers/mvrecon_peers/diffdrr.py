"""DiffDRR: Siddon's method and trilinear sampling as torch operations
(https://github.com/eigenvivek/DiffDRR).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import check_choice
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Traced, load
from mvrecon_peers.frame import chords, near

#: Samples per call on a GPU, to bound the memory: one sample requires about 50 bytes.
SAMPLES = 2**27
#: Added to a ray's direction (in voxels) to avoid division by zero. DiffDRR's own 1e-8 is visible
#: in float64; a much smaller value would move distant plane crossings out of the range of integers.
EPS = 1.1e-16
#: Rays along voxel faces are shifted by this many rounding errors; otherwise DiffDRR assigns them
#: to the even voxel.
NUDGE = 4


def require_whole(box: Grid, rig: Cameras) -> None:
    """Raise ValueError if a ray that comes near the box starts or ends inside it, or does not reach
    it although its line does.
    """
    first, last = near(box, *rig.rays())
    enter, leave = chords(box, first.detach(), last.detach())
    cut = (enter < leave) & ((enter < -1e-9) | (leave > 1 + 1e-9))
    if cut.any():
        raise ValueError(
            f"DiffDRR's Siddon traces infinite lines, so no ray may start or end in the box, got "
            f"{int(cut.sum())} of "
            f"{cut.numel()} rays that do; use method 'trilinear'"
        )


class Diffdrr(Traced):
    """DiffDRR's renderers for any central or parallel rig.

    Autograd computes the matched adjoint and the gradients, including those of the pose. Siddon
    traces infinite lines, so no ray may start or end in the box.

    Known limitations of the trilinear renderer in version 0.6.1: it truncates the samples at the
    box, half a voxel before the interpolation kernel ends, which underestimates objects at the
    box's faces; it overestimates a ray's length by the factor n / (n - 1), 1.002 with 500 samples;
    and it distributes the samples over the joint range of all rays rendered together, so a ray's
    value depends on the other rays, by a few per cent if few samples remain for it.

    Args:
        grid: voxels of the volume.
        cameras: the rig.
        method: "siddon" or "trilinear".
        samples: number of samples along a ray (trilinear), from the first entry to the last exit of
            the rays rendered together.

    Raises:
        ValueError: an unknown method, a geometry that `framed` does not support, or, for Siddon,
            rays that start or end inside the box.
        ImportError: DiffDRR is not installed.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "siddon", samples: int = 500):
        super().__init__(grid, cameras)
        check_choice("method", method, ("siddon", "trilinear"))
        self.method, self.samples = method, samples
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
        """DiffDRR's views. It expects volumes [x y z], rays in voxels, and their lengths in mm."""
        start, end = self.box.to_index(first), self.box.to_index(last)
        nudge = NUDGE * torch.finfo(first.dtype).eps * max(self.grid.shape)
        along = nudge * ((end - start).detach().abs() <= nudge)
        start, end = start + along, end + along
        length = (last - first).norm(dim=-1)[:, None]
        options = {} if self.method == "siddon" else {"n_points": self.samples}
        return self.renderer(volume.permute(2, 1, 0), start, end, length, **options)[:, 0]
