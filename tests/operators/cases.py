"""Cases for the operators of rays: every kind of rig, those whose columns stand upright over the
volume apart.
"""

from dataclasses import dataclass, replace

import torch

from mvrecon.geometry.cameras.camera import VECTORS, Cameras, ExplicitRays
from mvrecon.geometry.cameras.rigs import arc, circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.ray_transform import RayTransform
from tests.operators.rigs import AXIAL, GRID, INSIDE

METHODS = ("joseph", "siddon", "trilinear")
#: Each with the options that a projector takes; 5 samples miss most voxels, which no test here
#: minds.
OPTIONS = {
    **{method: {"method": method} for method in METHODS},
    "samples": {"method": "trilinear:5"},
}


@dataclass(frozen=True)
class Case:
    """A grid, the rays through it, and whether the loops for upright columns read it."""

    grid: Grid
    rays: Cameras | ExplicitRays
    upright: bool = False

    def build(self, **options) -> RayTransform:
        """The operator, of the CPU unless said otherwise."""
        return RayTransform(self.grid, self.rays, **({"backend": "cpu"} | options))

    @property
    def vectors(self) -> dict[str, torch.Tensor]:
        """The tensors that make the rays."""
        names = VECTORS if isinstance(self.rays, Cameras) else ("source", "target")
        return {name: getattr(self.rays, name) for name in names}

    def moved(self, *vectors: torch.Tensor) -> "Case":
        """The same with other tensors for the rays."""
        return replace(
            self, rays=replace(self.rays, **dict(zip(self.vectors, vectors, strict=True)))
        )


#: More slices than the least that is worth the loops for upright columns; no two sizes or spacings
#: alike.
TALL = Grid.centred(size=(9, 7, 11), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
#: Rows of a pitch that is not the slices', at places between them, that end inside the volume.
WITHIN = {"pixels": [8, 5], "pixel_mm": [0.83, 1.9], "offset_mm": [0.37, -0.3]}
#: Rows that reach beyond the volume.
BEYOND = {"pixels": [19, 5], "pixel_mm": [1.7, 2.3], "offset_mm": [-0.57, 0.2]}


def about(grid: Grid, rig: Cameras) -> Cameras:
    """A rig about the grid's centre in place of the origin."""
    return rig.moved(torch.eye(3), grid.centre)


def skewed(rig: Cameras) -> Cameras:
    """Rows that climb from column to column."""
    return replace(rig, u=rig.u + 0.313 * rig.v)


def curved(columns: int = 6, rows: int = 5, n_views: int = 2) -> ExplicitRays:
    """A detector on a cylinder about each source."""
    turn = torch.arange(n_views, dtype=torch.float64)[:, None, None] * 1.9 + 0.3
    fan = (torch.arange(columns, dtype=torch.float64) - (columns - 1) / 2) * 0.045 + 0.01
    height = (torch.arange(rows, dtype=torch.float64)[:, None] - (rows - 1) / 2) * 2.2 + 0.3
    source = 40 * torch.stack([turn.cos(), turn.sin(), 0 * turn], dim=-1)
    angle = turn + torch.pi + fan + 0 * height
    way = torch.stack([70 * angle.cos(), 70 * angle.sin(), height + 0 * angle], dim=-1)
    return ExplicitRays((source + 0 * way) + GRID.centre, source + way + GRID.centre)


TURNED = random_rotation(torch.Generator().manual_seed(3))
TILTED = parallel(3, WITHIN, 60.0, start_degrees=11.0).moved(TURNED, GRID.centre)

CASES = {
    "cone": Case(TALL, about(TALL, circular(5, 40.0, 70.0, WITHIN, start_degrees=13.0)), True),
    "cone beyond": Case(
        TALL, about(TALL, circular(5, 40.0, 70.0, BEYOND, start_degrees=29.0)), True
    ),
    "skewed cone": Case(
        TALL, about(TALL, skewed(circular(3, 40.0, 70.0, BEYOND, start_degrees=13.0))), True
    ),
    "stack": Case(TALL, about(TALL, parallel(4, WITHIN, 60.0, start_degrees=11.0)), True),
    "stack beyond": Case(TALL, about(TALL, parallel(4, BEYOND, 60.0, start_degrees=11.0)), True),
    "skewed stack": Case(
        TALL, about(TALL, skewed(parallel(3, BEYOND, 60.0, start_degrees=17.0))), True
    ),
    "endless stack": Case(
        TALL, about(TALL, replace(parallel(3, WITHIN, 60.0), extent="line")), True
    ),
    "cut stack": Case(TALL, about(TALL, parallel(3, WITHIN, 3.3, start_degrees=19.0)), True),
    "arc": Case(GRID, about(GRID, arc(3, 40.0, 70.0, WITHIN, 100.0, 5.0))),
    "dome": Case(GRID, about(GRID, dome(4, 30.0, 20.0, 120.0, WITHIN))),
    "tilted beams": Case(GRID, TILTED),
    "dcspect80": Case(
        Grid.centred(size=(7, 6, 5), spacing=(18.0, 22.0, 16.0)), dcspect80()[::16].binned(8)
    ),
    "axial": Case(GRID, AXIAL),
    "inside": Case(GRID, INSIDE),
    "explicit": Case(GRID, curved()),
}
UPRIGHT = {kind: case for kind, case in CASES.items() if case.upright}
#: Few rays, in poses where no ray lies on a kink: for derivatives by differences.
SMALL = Grid.centred(size=(3, 4, 3), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
FEW = {"pixels": [3, 2], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
DIFFERENTIABLE = {
    "cone": Case(SMALL, about(SMALL, circular(2, 40.0, 70.0, FEW, start_degrees=13.0))),
    "dome": Case(SMALL, about(SMALL, dome(2, 30.0, 20.0, 120.0, FEW))),
    "beams": Case(SMALL, parallel(2, FEW, 60.0, start_degrees=11.0).moved(TURNED, SMALL.centre)),
    "cut beams": Case(SMALL, parallel(2, FEW, 1.9, start_degrees=11.0).moved(TURNED, SMALL.centre)),
    "inside": Case(SMALL, replace(INSIDE[:2], shape=(3, 2))),
    "explicit": Case(SMALL, curved(2, 3)),
}


def noise(
    case: Case, dtype: torch.dtype = torch.float64, channels: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """A volume and views of noise."""
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(2, channels, *case.grid.shape, generator=rng, dtype=torch.float64)
    y = torch.randn(
        2, channels, len(case.rays), *case.rays.shape, generator=rng, dtype=torch.float64
    )
    return x.to(dtype), y.to(dtype)
