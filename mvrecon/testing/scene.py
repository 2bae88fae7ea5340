"""Contract checks of scenes."""

import math
from typing import Any

import torch

from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.operators.drr import Drr

GRID = Grid.centred(24, spacing=5.0)
RIG = circular(3, 400.0, 800.0, {"pixels": [32, 32], "pixel_mm": 8.0}, start_degrees=17.0)
#: Tolerance of the coarse truth's views relative to the norm of the exact ones.
MAX_VIEW_DIFFERENCE = 0.2


def check_scene(name: str, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named scene satisfies its contract on a small grid and rig.

    Float32 views [1 m v u] and truth [1 d h w], finite, the truth within the scene's value range
    and zero outside the object; the views are line integrals of the truth, within a coarse grid's
    accuracy; a case is a pure function of seed and index, and cases of distinct indices or
    seeds differ.

    Args:
        name: name of the scene.
        seed: seed of the series of cases.
        options: options of the scene.
    """
    scene = SCENES.build(name, **options)
    assert isinstance(scene, Scene), f"{name!r} is no subclass of mvrecon.data.scenes.sample.Scene"
    first, again = (scene.sample(0, seed, GRID, RIG) for _ in range(2))
    _check_case(scene, first)
    for what in ("views", "volume", "inside"):
        assert torch.equal(getattr(first, what), getattr(again, what)), (
            f"{what} of one case differ from call to call"
        )
    assert first.name == again.name, f"one case has the names {first.name!r} and {again.name!r}"
    expected = Drr(GRID, RIG)(first.volume[None])[0]
    error = ((first.views - expected).norm() / expected.norm()).item()
    assert error < MAX_VIEW_DIFFERENCE, (
        f"the views differ from line integrals of the truth (value times mm) by {error:.2g} of "
        f"their norm"
    )
    if scene.length is None or scene.length > 1:
        second = scene.sample(1, seed, GRID, RIG)
        assert second.name != first.name, f"two cases have the name {first.name!r}"
        assert not torch.equal(second.volume, first.volume), "two cases have the same truth"
    if scene.length is None:
        other = scene.sample(0, seed + 1, GRID, RIG)
        assert not torch.equal(other.volume, first.volume), "two seeds give the same truth"


def _check_case(scene: Scene, case: Sample) -> None:
    shapes = {"views": (1, len(RIG), *RIG.shape), "volume": (1, *GRID.shape)}
    for what, shape in shapes.items():
        tensor = getattr(case, what)
        assert tensor.shape == shape, f"{what} are {tuple(tensor.shape)}, expected {shape}"
        assert tensor.dtype == torch.float32, f"{what} are {tensor.dtype}, expected float32"
        assert tensor.isfinite().all(), f"{what} are not finite"
    assert case.inside.shape == case.volume.shape and case.inside.dtype == torch.bool, (
        "inside is no mask of the truth's shape"
    )
    assert not (case.volume * ~case.inside).any(), "the truth is not zero outside the object"
    ranged = 0 < scene.data_range < math.inf
    assert ranged and scene.unit, "a finite data_range above 0 and a unit are needed"
    top = case.volume.max().item()
    assert 0 < top <= scene.data_range * (1 + 1e-5), (
        f"the greatest value of the truth is {top:.3g}, the scene's range {scene.data_range:.3g}"
    )
