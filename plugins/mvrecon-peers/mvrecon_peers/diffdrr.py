"""DiffDRR: Siddon's method and trilinear sampling as torch operations (https://github.com/eigenvivek/DiffDRR)."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Traced, choice, load
from mvrecon_peers.frame import require_between

#: Samples in one call on a GPU, which bounds the memory: a sample takes some 50 bytes.
SAMPLES = 2**27


class Diffdrr(Traced):
    """DiffDRR's renderers, on any central or parallel rig.

    Matched adjoint and gradients, in the pose too, by autograd. Known of version 0.6.1: the trilinear renderer cuts its
    samples off at the box, half a voxel short of where the kernel ends, so that objects at the box's faces lose some;
    Siddon follows whole lines.

    Args:
        grid: where the voxels lie.
        cameras: the rig.
        method: "siddon" or "trilinear".
        samples: of the trilinear method on a ray, from the first entry to the last exit of the rays rendered together.

    Raises:
        ValueError: an unknown method, a geometry that `framed` does not take, or, for Siddon, a box that is not
            between sources and detectors.
        ImportError: DiffDRR is not installed.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "siddon", samples: int = 500):
        super().__init__(grid, cameras)
        self.method, self.samples = choice("method", method, ("siddon", "trilinear")), samples
        if method == "siddon":
            require_between(self.box, self.rig, "DiffDRR's Siddon")
        renderers = load("diffdrr.renderers", "diffdrr")
        self.renderer = renderers.Siddon() if method == "siddon" else renderers.Trilinear()

    def at_once(self, device: torch.device) -> int:
        """As many views as threads on a CPU, as memory allows on a GPU."""
        per_ray = sum(self.grid.shape) + 3 if self.method == "siddon" else self.samples
        rows, columns = self.cameras.shape
        fit = max(1, SAMPLES // (rows * columns * per_ray))
        return super().at_once(device) if device.type == "cpu" else min(fit, super().at_once(device))

    def render(
        self, volume: Float[Tensor, "d h w"], first: Float[Tensor, "k r 3"], last: Float[Tensor, "k r 3"]
    ) -> Float[Tensor, "k r"]:
        """DiffDRR's views: it takes volumes [x y z], rays in voxels, and their lengths in mm."""
        start, end = self.box.to_index(first), self.box.to_index(last)
        length = (last - first).norm(dim=-1)[:, None]
        options = {} if self.method == "siddon" else {"n_points": self.samples}
        return self.renderer(volume.permute(2, 1, 0), start, end, length, **options)[:, 0]
