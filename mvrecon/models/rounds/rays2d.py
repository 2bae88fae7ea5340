"""The cameras' network on images: what all cameras hold along a ray enters as channels."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.models.rounds.cells import from_cells, to_cells
from mvrecon.models.rounds.evidence import MAGNIFIED, SMALL, Evidence
from mvrecon.models.rounds.sampling import RaySamples
from mvrecon.models.rounds.unet import PlainUNet, Precision
from mvrecon.projectors.operator import Projector


class Rays2d(nn.Module):
    """Cameras' network in 2-D corrects each view by what the grid's operator would have measured,
    as a mean density along its rays.

    One U-Net for all cameras looks at cells of pixels of the view, of its residual and of its
    sharp part (the view less its mean over 3 x 3 pixels), and at the volume and its correction at
    some depths along each ray, one channel each.

    Args:
        projector: its grid and its rig.
        widths: channels of each scale, the finest first.
        depths: samples along a ray.
        binning: detector pixels joined into a cell along each axis, at most; the largest number
            that divides rows and columns is taken.
        memory: channels handed on to the cameras' network of a later round.
        precision: of the convolutions.

    Raises:
        ValueError: explicit rays, which have no image.
    """

    def __init__(
        self,
        projector: Projector,
        widths: Sequence[int] = (32, 48),
        depths: int = 16,
        binning: int = 3,
        memory: int = 8,
        precision: Precision = "float32",
    ):
        super().__init__()
        cameras = projector.cameras
        if not isinstance(cameras, Cameras):
            raise ValueError(
                f"Expected a rig of cameras for 'rays2d', got {type(cameras).__name__}"
            )
        rows, columns = cameras.shape
        edge = max(k for k in range(1, binning + 1) if rows % k == 0 and columns % k == 0)
        self.edge = edge
        self.samples = RaySamples(projector.grid, cameras.binned(edge), depths)
        self.memory_shape = len(cameras), memory, rows // edge, columns // edge
        inputs, outputs = 3 * edge**2 + 2 * depths + memory, edge**2 + memory
        self.unet = PlainUNet(2, inputs, outputs, widths, zero=edge**2, precision=precision)

    def forward(
        self, evidence: Evidence
    ) -> tuple[Float[Tensor, "b 1 m v u"], Float[Tensor, "b m k r s"]]:
        """The correction R e of every view, and the memory."""
        b, m = evidence.memory.shape[:2]
        images = self._images(evidence).flatten(0, 1)
        volumes = torch.cat([evidence.volume, MAGNIFIED * evidence.change], dim=1)
        along = self.samples(volumes).flatten(2, 3).flatten(0, 1)
        answer = self.unet(torch.cat([images, along, evidence.memory.flatten(0, 1)], dim=1))
        cells, memory = answer.split([self.edge**2, evidence.memory.shape[2]], dim=1)
        correction = from_cells(cells, self.edge).unflatten(0, (b, m)).transpose(1, 2)
        return SMALL * correction, memory.unflatten(0, (b, m))

    def _images(self, evidence: Evidence) -> Float[Tensor, "b m k r s"]:
        measured = evidence.measured.squeeze(1)
        mean = F.avg_pool2d(measured, 3, stride=1, padding=1, count_include_pad=False)
        residual = MAGNIFIED * evidence.residual.squeeze(1)
        views = torch.stack([residual, measured, MAGNIFIED * (measured - mean)], dim=2)
        return to_cells(views.flatten(0, 1), self.edge).unflatten(0, measured.shape[:2])
