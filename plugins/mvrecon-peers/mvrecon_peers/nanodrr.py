"""nanodrr: a trilinear ray marcher in torch, with a Triton kernel on CUDA
(https://github.com/eigenvivek/nanodrr).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Traced, load


class Nanodrr(Traced):
    """nanodrr's trilinear renderer, with the same number of samples on every ray within the box
    extended by the kernel.

    Autograd computes the matched adjoint and the gradients, including those of the pose. Supports
    every rig of mvrecon, including parallel ones.

    Args:
        grid: voxels of the volume.
        cameras: the rig.
        samples: number of samples along a ray; by default the number of voxels along the grid's
            diagonal.
        backend: nanodrr's own: "auto", "torch", "triton".

    Raises:
        ValueError: a geometry that `framed` does not support, or fewer than 2 samples.
        ImportError: nanodrr is not installed.
    """

    def __init__(
        self, grid: Grid, cameras: Cameras, samples: int | None = None, backend: str = "auto"
    ):
        super().__init__(grid, cameras)
        self.samples, self.backend = samples or max(2, math.ceil(math.hypot(*grid.shape))), backend
        if self.samples < 2:
            raise ValueError(f"nanodrr takes at least 2 samples on a ray, got {samples}")
        self.subject = load("nanodrr.data", "nanodrr", "Subject")
        self.march = load("nanodrr.drr.renderer", "nanodrr", "render")

    def render(
        self,
        volume: Float[Tensor, "d h w"],
        first: Float[Tensor, "k r 3"],
        last: Float[Tensor, "k r 3"],
    ) -> Float[Tensor, "k r"]:
        """nanodrr's views on the whole detector, since its kernel processes neighbouring pixels
        together. The ray end points define their position.
        """
        x = volume[None, None]
        affine, counts = self.box.affine.to(volume), volume.new_tensor(volume.shape[::-1])
        # nanodrr's own has seven digits
        scale = torch.diag(torch.cat([2 / counts, counts.new_ones(1)]))
        scale[:3, 3] = 1 / counts - 1
        subject = self.subject(
            x, torch.zeros_like(x), affine, affine.inverse(), scale, affine[:3, 3], 0
        )
        subject.convert_to_mu = False
        still = torch.eye(4).to(volume).expand(len(first), 4, 4)
        frame = still[:, :3, :3], still, volume.new_ones(len(first))
        ends = {"src": first, "tgt": last}
        sizes = *self.cameras.shape, self.samples
        return self.march(subject, *frame, *sizes, backend=self.backend, **ends)[:, 0].flatten(1)
