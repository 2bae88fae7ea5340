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
    """nanodrr's trilinear renderer: equally many samples on every ray's part in the box grown by
    the kernel.

    Matched adjoint and gradients, in the pose too, by autograd. Takes every rig of mvrecon,
    parallel ones included.

    Args:
        grid: where the voxels lie.
        cameras: the rig.
        samples: on a ray; as many as voxels fit along the grid's diagonal by default.
        backend: nanodrr's own: "auto", "torch", "triton".

    Raises:
        ValueError: a geometry that `framed` does not take, or fewer than 2 samples.
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
        """nanodrr's views, on the whole detector, since its kernel takes neighbouring pixels
        together; the ends of the rays tell where they lie.
        """
        x = volume[None, None]
        affine, counts = self.box.affine.to(volume), volume.new_tensor(volume.shape[::-1])
        scale = torch.diag(
            torch.cat([2 / counts, counts.new_ones(1)])
        )  # nanodrr's own has seven digits
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
