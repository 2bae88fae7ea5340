"""Rigs, grids and objects at random, with what is known of them."""

from dataclasses import dataclass, replace

import torch

from mvrecon.core.numbers import uniform
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_in_ball, random_rotation
from mvrecon.operators.ray_transform import RayTransform

KINDS = ("cone", "inside", "ahead", "beams", "endless beams", "pinholes", "dcspect80")


@dataclass(frozen=True)
class World:
    """A grid, a rig, and something to be seen."""

    grid: Grid
    cameras: Cameras
    phantom: Phantom

    @property
    def views(self) -> torch.Tensor:
        """Exact views [1 1 m v u] by closed-form integrals."""
        start, end = self.cameras.rays()
        return self.phantom.integrals(start, end, self.cameras.ray_extent)[None, None]


def operator(world: World, method: str = "joseph") -> RayTransform:
    """The oracle's operator of a world, which shares no code with what is tested."""
    return RayTransform(world.grid, world.cameras, method=method, backend="reference")


def random_world(kind: str, seed: int) -> World:
    """A turned and shifted oblong grid of about 24 voxels, a rig about it, and bodies nowhere
    thinner than the rays are apart: ellipsoids whose least radius of curvature is half the widest
    pixel's diagonal."""
    rng = torch.Generator().manual_seed(1000 * KINDS.index(kind) + seed)
    scale = 9.0 if kind == "dcspect80" else 1.0
    spacing = [scale * uniform(rng, 0.7, 1.3) for _ in range(3)]
    shape = [int(torch.randint(18, 27, (), generator=rng)) for _ in range(3)]
    grid = Grid.centred(size=shape[::-1], spacing=spacing)
    cameras = _rig(kind, rng)
    cameras = cameras.moved(
        random_rotation(rng), 0.2 * scale * torch.randn(3, generator=rng, dtype=torch.float64)
    )
    thinnest = _widest_pixel(cameras, grid) / 2
    field = 0.4 * min(n * step for n, step in zip(grid.shape[::-1], grid.spacing, strict=True))
    count = int(torch.randint(1, 4, (), generator=rng))
    # c^2 / a >= thinnest
    axes = torch.stack([_axes(rng, thinnest, 0.5 * field) for _ in range(count)])
    centres = torch.stack([random_in_ball(rng, field) for _ in range(count)])
    phantom = Phantom(
        (Solids("ellipsoid", centres, random_rotation(rng, count), axes, torch.ones(count)),)
    )
    turn, shift = random_rotation(rng), 50 * torch.randn(3, generator=rng, dtype=torch.float64)
    return World(grid.moved(turn, shift), cameras.moved(turn, shift), phantom.moved(turn, shift))


def _axes(rng: torch.Generator, thinnest: float, largest: float) -> torch.Tensor:
    longest = max(thinnest, uniform(rng, 0.3, 1.0) * largest)
    shortest = (thinnest * longest) ** 0.5
    return torch.tensor([uniform(rng, shortest, longest), longest, shortest], dtype=torch.float64)


def _widest_pixel(cameras: Cameras, grid: Grid) -> float:
    """Diagonal in mm of the widest pixel, where the rays that count pass the grid."""
    diagonal = (
        torch.maximum((cameras.u + cameras.v).norm(dim=1), (cameras.u - cameras.v).norm(dim=1))
        .amax()
        .item()
    )
    if cameras.parallel:
        return diagonal
    w = cameras.project(grid.corners())[..., 2] / cameras.distance[:, None]
    first, last = cameras.ray_extent
    return diagonal * w.clamp(first, last).abs().amax().item()


def _rig(kind: str, rng: torch.Generator) -> Cameras:
    views, start = int(torch.randint(2, 9, (), generator=rng)), uniform(rng, 0, 90)
    detector = {
        "pixels": [21, 26],
        "pixel_mm": [uniform(rng, 1.6, 2.6), uniform(rng, 1.6, 2.6)],
        "offset_mm": 0.3,
    }
    if kind == "cone":
        return circular(views, 50.0, 80.0, detector, start_degrees=start)
    if kind == "ahead":
        return replace(circular(views, 50.0, 80.0, detector, start_degrees=start), extent="ahead")
    if kind == "inside":  # sources and detectors in the volume
        return circular(views, 6.0, 14.0, detector | {"pixel_mm": 0.9}, start_degrees=start)
    if kind == "beams":  # as deep as the volume or less
        return parallel(
            views, detector | {"pixel_mm": 1.4}, uniform(rng, 8, 40), start_degrees=start
        )
    if kind == "endless beams":
        return replace(
            parallel(views, detector | {"pixel_mm": 1.4}, 60.0, start_degrees=start), extent="line"
        )
    if kind == "pinholes":
        return dome(views, 45.0, 30.0, 160.0, detector | {"pixel_mm": 1.3})
    return dcspect80([20, 24])[torch.randperm(80, generator=rng)[:views].tolist()]
