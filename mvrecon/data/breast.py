"""The scene of breast-like slices, with views by the projector from its own grid or a finer one."""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.ray_transform import RayTransform
from mvrecon.scenes.analytic import generator
from mvrecon.scenes.breast import Tissues, random_specks, random_texture, slice_values
from mvrecon.scenes.sample import Sample


@dataclass(frozen=True, kw_only=True)
class BreastSlices:
    """Breast-like slices in 1/mm, endless: fat, fibroglandular tissue, skin, small bright specks.

    As in the AAPM challenge on sparse-view CT (Sidky and Pan, Med. Phys. 49, 2022), whose views are
    noise-free integrals of the pixels themselves: `fine: 1` gives views that a volume on the grid
    explains exactly, with the projector's own `method`. From a finer grid no volume does.

    Args:
        field: radius of the breast as a fraction of the grid's shorter edge across z.
        detail: periods of the texture's finest wave across the breast's diameter.
        edge_mm: width of the tissues' boundaries; 0 for steps, so that the gradient is sparse.
        specks: how many in a slice, from and to.
        fine: views are projected from a grid so many times finer, and the truth is its mean.
        method: of the projector that makes the views.

    Raises:
        ValueError: numbers out of range.
    """

    field: float = 0.45
    detail: int = 12
    edge_mm: float = 0.0
    specks: tuple[int, int] = (5, 20)
    fine: int = 1
    method: str = "joseph"

    unit: ClassVar[str] = "1/mm"
    length: ClassVar[int | None] = None

    def __post_init__(self) -> None:
        least, most = self.specks
        if not 0 < self.field <= 0.5:
            raise ValueError(
                f"The field must be a fraction in (0, 0.5] of the grid's edge, got {self.field}"
            )
        if self.detail < 1 or self.fine < 1 or not self.edge_mm >= 0 or not 0 <= least <= most:
            raise ValueError(
                f"Expected detail and fine of at least 1, edge_mm of at least 0 and specks as "
                f"(from, to), got {self.detail}, {self.fine}, {self.edge_mm} and {self.specks}"
            )

    @property
    def data_range(self) -> float:
        """The fixed range of values that PSNR and SSIM refer to."""
        return Tissues().speck

    def sample(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Sample:
        """The case `index` of the series `seed`, seen by `cameras`, with its truth on `grid`."""
        volume = self.finer(index, seed, grid, cameras, self.fine)
        with torch.no_grad():
            A = RayTransform(grid.refined(self.fine), cameras, method=self.method)
            views = A(volume[None])[0]
        truth = F.avg_pool3d(volume, self.fine)
        return Sample(views, truth, truth > 0, f"breast-{seed}-{index}")

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Cameras, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's attenuation on `grid.refined(factor)`, at the centres of its voxels.

        Slices are as thick as those of `grid`: nothing changes within one.
        """
        rng = generator(seed, index)
        texture = random_texture(rng, self.detail)
        x_mm, y_mm, z_mm = grid.spacing
        depth, height, width = grid.shape
        radius = self.field * min(height * y_mm, width * x_mm)
        y, x = (
            centred(n * factor) * step / (factor * radius)
            for n, step in ((height, y_mm), (width, x_mm))
        )
        slices = [
            slice_values(
                texture,
                random_specks(rng, self.specks),
                Tissues(),
                y,
                x,
                z,
                self.edge_mm / radius,
            )
            for z in (centred(depth) * z_mm / radius).tolist()
        ]
        volume = torch.stack(slices).to(torch.float32).repeat_interleave(factor, dim=0)
        return volume[None]


def centred(count: int) -> Float[Tensor, " n"]:
    """Indices of cells counted from their middle."""
    return torch.arange(count, dtype=torch.float64) - (count - 1) / 2
