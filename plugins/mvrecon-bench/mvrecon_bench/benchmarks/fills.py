"""Scenes of `bench=skip`: objects that fill between 1/300 and all of their cube."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.numbers import generator
from mvrecon.core.parts import SCENES
from mvrecon.data.attenuation import WATER
from mvrecon.data.body import body, enclosed
from mvrecon.data.scenes.analytic import AnalyticScene
from mvrecon.data.scenes.solids import voxelise
from mvrecon.data.volumes import TISSUE, FileScene
from mvrecon.geometry.grid import Grid, voxel_centres

#: Default edge of the cube in mm; wavelength of the tissue's variation in mm.
FIELD, WAVE = 256.0, 120.0


def cube(config: Mapping[str, Any], n: int) -> Grid:
    """The n^3 voxels of a scene's cube, `field_mm` long."""
    return Grid.centred((n,) * 3, config.get("field_mm", FIELD) / n)


def filled(config: Mapping[str, Any], grid: Grid) -> tuple[Float[Tensor, "d h w"], str]:
    """The volume of a scene, and its origin.

    Args:
        config: `volume`: a scene of phantoms or of files in the registry, `{name: body, fill: ...,
            axes: ...}`, or `{name: random}`; `instead`: the volume if the path of a file is null;
            `case`: index of the case.
        grid: grid of the volume.

    Raises:
        TypeError: an unsupported kind of scene.
    """
    volume, case = config["volume"], config.get("case", 0)
    options = dict(config["instead"] if volume.get("path", "") is None else volume)
    if (name := options["name"]) == "random":
        values = torch.rand(grid.shape, generator=generator(0, case)) + 0.5
        return values, "random values in 0.5 .. 1.5"
    if name == "body":
        del options["name"]
        return phantom_body(grid, **options), f"body of {options['fill']:.0%}"
    scene = SCENES.from_config(options)
    if isinstance(scene, AnalyticScene):
        return voxelise(scene.phantom(generator(0, case), grid), grid), name
    if not isinstance(scene, FileScene):
        raise TypeError(f"bench=skip needs a scene of phantoms or of files, got {name!r}")
    (truth,) = scene.finer(case, 0, grid, None, 1)
    patient = scene.case(case)[0]
    return truth * enclosed(body(truth, TISSUE)), f"{patient}, without couch and air"


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
    scale = torch.tensor([1 / axis if axis else 0.0 for axis in axes], dtype=xyz.dtype)
    radius = (xyz * scale).norm(dim=-1)
    edge = radius.flatten().kthvalue(max(1, round(fill * radius.numel()))).values
    tissue = WATER * (1 + 0.2 * (2 * math.pi / WAVE * xyz).cos().prod(dim=-1))
    return torch.where(radius <= edge, tissue, 0.0).float()
