"""The cameras' network in frusta: a 3-D U-Net in each camera's own frustum."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.models.cross_view.evidence import MAGNIFIED, Answer, Evidence, Task
from mvrecon.models.cross_view.sampling import FixedFrusta
from mvrecon.models.cross_view.shared import for_cameras
from mvrecon.models.cross_view.unet import PlainUNet, Precision
from mvrecon.models.cross_view.views import IMAGES, Binned, correction_of, image_cells, means
from mvrecon.models.networks import halved
from mvrecon.models.pooling import deviation, leave_one_out
from mvrecon.projectors.operator import Projector

#: Volumes in a frustum: two lifts, the volume and its change, mean and deviation of either lift of
#: the others, which bins are in the grid's box, and their depth.
VOLUMES = 10


class Frustum3d(nn.Module):
    """Cameras' network in 3-D corrects each view by what the grid's operator would have measured,
    as a mean density along its rays, from volumes in the camera's frustum.

    A 3-D U-Net looks at the lifts of the view and of its residual, at the mean and the deviation of
    these of all other cameras (leave-one-out, at half the grid's resolution), at the volume and its
    correction, and at features of the camera's pixels; a mean along each ray leads to the view.

    Args:
        projector: its grid and its rig.
        task: what the round asks for.
        widths: channels of each scale, the finest first.
        depths: bins along a ray.
        binning: detector pixels joined into a cell along each axis, at most; the largest number
            that divides rows and columns is taken.
        memory: channels handed on to the cameras' network of a later round.
        precision: of the convolutions in 3-D.

    Raises:
        ValueError: explicit rays, which have no image.
    """

    def __init__(
        self,
        projector: Projector,
        task: Task,
        widths: Sequence[int] = (16, 32),
        depths: int = 16,
        binning: int = 3,
        memory: int = 8,
        precision: Precision = "float32",
    ):
        super().__init__()
        cameras, edge = Binned.of(projector, binning)
        self.binning, self.depths, self.task = edge, depths, task
        self.inside = FixedFrusta(projector.grid.coarsened(2), cameras, depths)
        self.memory_shape = len(cameras), memory, *cameras.shape
        width, pixels = widths[0], IMAGES * edge**2 + memory
        self.sizes = [task.logits + task.features, memory, task.correct * width]

        def unet() -> nn.Module:
            inputs, outputs = width + VOLUMES, sum(self.sizes)
            return PlainUNet(3, inputs, outputs, widths, zero=task.logits, precision=precision)

        def last() -> nn.Module:
            conv = nn.Conv2d(width + pixels, edge**2, 1, bias=False)
            nn.init.zeros_(conv.weight)
            return conv

        self.pixels = for_cameras(task.shared, len(cameras), lambda: nn.Conv2d(pixels, width, 1))
        self.unet = for_cameras(task.shared, len(cameras), unet)
        self.last = for_cameras(task.shared, len(cameras), last) if task.correct else None

    def forward(self, evidence: Evidence) -> Answer:
        """The correction of every view, the memory, and what is placed in the frusta."""
        b, m = evidence.memory.shape[:2]
        occupied = self.inside.frusta.occupied.to(evidence.volume.dtype)
        images = torch.cat([image_cells(evidence, self.binning), evidence.memory], dim=2)
        images = images.flatten(0, 1)
        pixels = self.pixels(images)[:, :, None].expand(-1, -1, self.depths, -1, -1)
        volumes = self._volumes(evidence, occupied).flatten(0, 1)
        answer = self.unet(torch.cat([pixels, volumes], dim=1)).unflatten(0, (b, m))
        placed, *flat = answer.split(self.sizes, dim=2)
        lengths = occupied.sum(dim=2).clamp_min(1)
        memory, along = ((part * occupied).sum(dim=3) / lengths for part in flat)
        correction = None
        if self.last is not None:
            cells = self.last(torch.cat([along.flatten(0, 1), images], dim=1))
            correction = correction_of(cells, self.binning, b)
        return Answer(memory, correction, placed if self.task.logits else None)

    def _volumes(
        self, evidence: Evidence, occupied: Float[Tensor, "m 1 D r s"]
    ) -> Float[Tensor, "b m c D r s"]:
        """What is in each frustum: of the camera, of the volume, and of all other cameras."""
        frusta = self.inside.frusta
        views = torch.cat([evidence.measured, MAGNIFIED * evidence.residual], dim=1)
        lifted = means(views, self.binning).transpose(1, 2)[:, :, :, None] * occupied
        mean, variance, _ = leave_one_out(frusta.to_world(lifted), frusta.visible)
        others = frusta.to_frusta(torch.cat([mean, deviation(variance)], dim=2))
        volumes = halved(torch.cat([evidence.volume, MAGNIFIED * evidence.change], dim=1))
        ours = frusta.to_frusta(volumes[:, None])
        where = torch.cat([occupied, occupied * frusta.depths(occupied)], dim=1)
        where = where.expand(len(lifted), -1, -1, -1, -1, -1)
        return torch.cat([lifted, ours, others, where], dim=2)
