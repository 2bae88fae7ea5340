"""Scenes of `bench=skip`: objects that fill between 1/300 and all of their cube."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import generator
from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.attenuation import WATER
from mvrecon.data.body import body, enclosed
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.sample import Scene
from mvrecon.data.scenes.solids import voxelise
from mvrecon.data.volumes import TISSUE, FileScene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.operators.operator import Projector

#: Default edge of the cube in mm.
FIELD = 256.0
#: Wavelength of the tissue's variation in mm.
WAVE = 120.0


@dataclass(frozen=True, eq=False)
class Filled:
    """A volume and its origin."""

    volume: Float[Tensor, "d h w"]
    grid: Grid
    source: str


def cube(config: Mapping[str, Any], n: int) -> Grid:
    """The n^3 voxels of a scene's cube, `field_mm` long."""
    return Grid.centred((n,) * 3, config.get("field_mm", FIELD) / n)


def edge(grid: Grid) -> float:
    """Length of a cube in mm."""
    return grid.shape[0] * grid.spacing[0]


def filled(config: Mapping[str, Any], grid: Grid) -> Filled:
    """The volume of a scene.

    Args:
        config: `volume`: a scene of phantoms or of files in the registry, `{name: body, fill: ...,
            axes: ...}`, or `{name: random}`; `instead`: the volume if the path of a file is null;
            `case`: index of the case.
        grid: grid of the volume.

    Raises:
        TypeError: an unsupported kind of scene.
    """
    options, case = _chosen(config), config.get("case", 0)
    if options["name"] == "random":
        return Filled(
            torch.rand(grid.shape, generator=generator(0, case)) + 0.5,
            grid,
            "random values in 0.5 .. 1.5",
        )
    if options["name"] == "body":
        options.pop("name")
        return Filled(phantom_body(grid, **options), grid, f"body of {options['fill']:.0%}")
    scene = SCENES.from_config(options)
    if isinstance(scene, AnalyticScene):
        return Filled(
            voxelise(scene.phantom(generator(0, case), grid), grid), grid, options["name"]
        )
    if not isinstance(scene, FileScene):
        raise TypeError(
            f"bench=skip needs a scene of phantoms or of files, got {options['name']!r}"
        )
    (truth,) = scene.finer(case, 0, grid, None, 1)
    patient = scene.case(case)[0]
    return Filled(truth * enclosed(body(truth, TISSUE)), grid, f"{patient}, without couch and air")


@dataclass(frozen=True, eq=False)
class Seen:
    """The input of a model for one case, and its truth."""

    views: Float[Tensor, "1 1 m v u"]
    volume: Float[Tensor, "1 d h w"]
    inside: Bool[Tensor, "1 d h w"]
    source: str


def seen(config: Mapping[str, Any], A: Projector, index: int = 0) -> Seen:
    """A case of a scene with its own views, exact or from a finer grid; with views by A if the
    scene is not in the registry.
    """
    options, case = _chosen(config), config.get("case", 0) + index
    if options["name"] in ("random", "body"):
        body = filled({**config, "case": case}, A.grid)
        volume = body.volume[None]
        return Seen(A(volume[None]), volume, volume > 0, body.source)
    scene: Scene = SCENES.from_config(options)
    sample = scene.sample(case, 0, A.grid, A.cameras)
    return Seen(sample.views[None], sample.volume, sample.inside, sample.name)


def _chosen(config: Mapping[str, Any]) -> dict[str, Any]:
    volume = config["volume"]
    return dict(config["instead"] if volume.get("path", "") is None else volume)


def phantom_body(
    grid: Grid, fill: float, axes: Sequence[float | None] = (1.35, 1.0, None)
) -> Float[Tensor, "d h w"]:
    """Tissue with smoothly varying attenuation in a central ellipsoid that fills a given fraction
    of the voxels.

    Args:
        grid: grid of the volume, which truncates the ellipsoid.
        fill: fraction of the voxels.
        axes: proportions of the semi-axes along x, y, z; null: extends through the volume.

    Raises:
        ValueError: fill is outside (0, 1].
    """
    if not 0 < fill <= 1:
        raise ValueError(f"A body's fill must be a part in (0, 1] of the volume, got {fill}")
    xyz = voxel_centres(grid) - grid.centre
    radius = (
        xyz * torch.tensor([1 / axis if axis else 0.0 for axis in axes], dtype=xyz.dtype)
    ).norm(dim=-1)
    edge = radius.flatten().kthvalue(max(1, round(fill * radius.numel()))).values
    tissue = WATER * (1 + 0.2 * (2 * math.pi / WAVE * xyz).cos().prod(dim=-1))
    return torch.where(radius <= edge, tissue, 0.0).float()


def rig(config: Mapping[str, Any], field: float, n: int) -> Cameras:
    """Build the cameras of a configuration in the registry.

    With `cover`, the detector is a square whose edge is this multiple of the field of view, with
    `pixels` along it (n if null or absent); `detector` is ignored.
    """
    options = dict(config)
    if (cover := options.pop("cover", None)) is not None:
        pixels = options.pop("pixels", None) or n
        options["detector"] = {"pixels": [pixels, pixels], "pixel_mm": cover * field / pixels}
    return CAMERAS.from_config(options)
