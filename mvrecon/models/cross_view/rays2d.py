"""The cameras' network on images: what all cameras hold along a ray enters as channels."""

from collections.abc import Sequence

import torch
from torch import nn

from mvrecon.models.cross_view.evidence import MAGNIFIED, Answer, Evidence, Task
from mvrecon.models.cross_view.sampling import RaySamples
from mvrecon.models.cross_view.shared import for_cameras
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.cross_view.views import IMAGES, Binned, correction_of, image_cells
from mvrecon.projectors.operator import Projector


class Rays2d(nn.Module):
    """Cameras' network in 2-D corrects each view by what the grid's operator would have measured,
    as a mean density along its rays.

    One U-Net for all cameras looks at cells of pixels of the view, of its residual and of its
    sharp part (the view less its mean over 3 x 3 pixels), and at the volume and its correction at
    some depths along each ray, one channel each. Logits and features in the frusta are channels,
    too.

    Args:
        projector: its grid and its rig.
        task: what the round asks for.
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
        task: Task,
        widths: Sequence[int] = (32, 48),
        depths: int = 16,
        binning: int = 3,
        memory: int = 8,
        precision: Precision = "float32",
    ):
        super().__init__()
        cameras, edge = Binned.of(projector, binning)
        self.binning, self.depths, self.task = edge, depths, task
        self.samples = RaySamples(projector.grid, cameras, depths)
        self.memory_shape = len(cameras), memory, *cameras.shape
        logits = task.correct * edge**2, task.logits * depths
        inputs = IMAGES * edge**2 + 2 * depths + memory
        self.sizes = [*logits, task.features * depths, memory]
        self.unet = for_cameras(
            task.shared,
            len(cameras),
            lambda: PlainUNet(
                2, inputs, sum(self.sizes), widths, zero=sum(logits), precision=precision
            ),
        )

    def forward(self, evidence: Evidence) -> Answer:
        """The correction of every view, the memory, and what is placed in the frusta."""
        b, m = evidence.memory.shape[:2]
        images = image_cells(evidence, self.binning).flatten(0, 1)
        volumes = torch.cat([evidence.volume, MAGNIFIED * evidence.change], dim=1)
        along = self.samples(volumes).flatten(2, 3).flatten(0, 1)
        answer = self.unet(torch.cat([images, along, evidence.memory.flatten(0, 1)], dim=1))
        cells, logits, features, memory = answer.split(self.sizes, dim=1)
        correction = correction_of(cells, self.binning, b) if self.task.correct else None
        placed = None
        if self.task.logits:
            placed = torch.cat([logits, features], dim=1)
            placed = placed.unflatten(0, (b, m)).unflatten(2, (-1, self.depths))
        return Answer(memory.unflatten(0, (b, m)), correction, placed)
