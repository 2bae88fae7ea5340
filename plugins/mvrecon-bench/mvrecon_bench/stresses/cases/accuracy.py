"""Accuracy of views: orders of convergence in the voxel size, and comparison with other libraries'
projectors.
"""

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon.testing.measures import gap
from mvrecon_bench.stresses.analytic import Blob
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.subject import ProjectorSubject

#: Grids on which an order of convergence is measured, along each axis, in a box of 48 mm.
GRIDS = (16, 32, 64)
#: Projectors of other libraries that support any rig (plugin mvrecon-peers): Joseph's and Siddon's
#: methods, and sampling.
ORACLES = ("rtk", "diffdrr", "nanodrr")


def smooth(subject: ProjectorSubject) -> float:
    """Deficit of the order of convergence from two for a blob, or from 0.9 if voxels are cells."""
    blob = Blob(torch.tensor([1.3, -0.7, 0.4], dtype=torch.float64), 5.0)
    return (0.9 if subject.of_cells else 1.8) - _order(
        subject, blob.values, lambda rig: blob.integrals(*rig.rays())
    )


def sharp(subject: ProjectorSubject) -> float:
    """Deficit of the order of convergence from one for a supersampled ellipsoid, cylinder and
    box.
    """
    solids = _solids()
    return 0.9 - _order(
        subject, _voxels, lambda rig: solids.integrals(*rig.rays(), ray_extent=rig.ray_extent)
    )


def oracles(subject: ProjectorSubject) -> float:
    """Minimum difference from other libraries' projections of a blob that decays within the
    grid.

    For a plugin's projector, mvrecon's own projectors are included.
    """
    subject.need_lines()
    grid = Grid.centred((49, 49, 49), 1.0, (3.0, -2.0, 4.0))
    rig = subject.rig(grid, {"pixels": [9, 11], "pixel_mm": [0.9, 0.8], "offset_mm": [0.04, -0.03]})
    volume = Blob(grid.centre + 0.4, 5.5).values(grid).to(subject.device, subject.dtype)[None, None]
    views, gaps = subject.projector(grid, rig)(volume), []
    others = [{"name": name} for name in set(ORACLES) & set(PROJECTORS.names()) - {subject.name}]
    if not subject.ours:
        others += [
            {"name": "radon" if rig.parallel else "drr", "method": method} for method in RAY_METHODS
        ]
    for other in others:
        try:
            B = PROJECTORS.from_config(other, grid=grid, cameras=rig)
            gaps.append(gap(views, B(volume.cpu())))
        except (ImportError, ValueError):  # not installed, or the rig is not supported
            continue
    if not gaps:
        raise DoesNotApply(
            "no other library's projector is installed that takes this rig; see mvrecon-peers"
        )
    return min(gaps)


def _order(
    subject: ProjectorSubject, volume: Callable[[Grid], Tensor], truth: Callable[[Cameras], Tensor]
) -> float:
    """Slope of the error over three grids, from finest to coarsest."""
    subject.need_lines()
    rig = subject.rig(
        _box(GRIDS[0]),
        {"pixels": [20, 21], "pixel_mm": [0.31, 0.33], "offset_mm": [0.03, 0.05]},
        n_views=4,
    )
    rig = rig.moved(
        random_rotation(torch.Generator().manual_seed(0)), torch.zeros(3)
    )  # otherwise rows would coincide with slices
    errors = []
    for n in GRIDS:
        x = volume(_box(n)).to(subject.device, subject.dtype)[None, None]
        errors.append(gap(subject.projector(_box(n), rig)(x)[0, 0], truth(rig)))
    return float(torch.tensor(errors[0] / errors[-1]).log2()) / (len(errors) - 1)


def _box(n: int) -> Grid:
    """Voxels of 48 / n mm, a third longer along z."""
    return Grid.centred((n, n, n), (48 / n, 48 / n, 64 / n))


def _solids() -> Phantom:
    rng = torch.Generator().manual_seed(5)
    places = torch.tensor(
        [[1.0, -2.0, 4.5], [-9.0, 6.0, -12.0], [8.0, 5.0, -10.0]], dtype=torch.float64
    )
    axes = torch.tensor([[13.0, 16.0, 11.0], [6.0, 7.0, 9.0], [7.0, 5.0, 8.0]], dtype=torch.float64)
    kinds = zip(("ellipsoid", "cylinder", "box"), places, axes, strict=True)
    one = torch.ones(1)
    return Phantom(
        tuple(Solids(kind, p[None], random_rotation(rng, 1), a[None], one) for kind, p, a in kinds)
    )


@lru_cache(maxsize=8)
def _voxels_of(n: int) -> Tensor:
    return voxelise(_solids(), _box(n))


def _voxels(grid: Grid) -> Tensor:
    return _voxels_of(grid.shape[0])


CASES = (
    Case(
        31, "a smooth blob on three grids", "error falls by the stated order", "projector", smooth
    ),
    Case(
        31,
        "solids with edges on three grids",
        "error falls by the stated order",
        "projector",
        sharp,
    ),
    Case(
        32,
        "a blob, compared with other libraries",
        "equal views of at least one library",
        "projector",
        oracles,
        1e-3,
    ),
)
