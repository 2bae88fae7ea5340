"""Breathing: views of an object that is deformed smoothly, at rest at its back.

Tissue moves forward and towards the feet, as by inhaling, along one direction d in the axes of the
grid (y the front, z the head). A point X of the object deformed by a mm shows what is at
X - a s(X) d at rest. s, from 0 to 1, is a product of profiles along x, y and z in units of the
grid's box: zero from the spine backwards, rising to the front of the body, and zero at the sides,
top and bottom, all with zero slope. Values move with the tissue, as CT numbers do: no Jacobian.

d is constant, so the map's Jacobian has the determinant 1 - a d . grad s: where that is positive,
the map is monotone along every line in direction d, hence invertible.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.geometry.lattice import normalised, sample
from mvrecon.operators.operator import Projector
from mvrecon.operators.selection import view_subset

#: Unit vector d (x, y, z): the diaphragm moves about three times as far down as the chest forward.
DIRECTION = (0.0, 1 / math.sqrt(10), -3 / math.sqrt(10))
#: Places along y, in units of the box from its centre, between which the displacement rises: in
#: head-neck CT most spines lie behind the first, and the chin lies at the second.
SPINE, FRONT = 0.05, 0.35


def share(places: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """The displacement s of points (x, y, z), in units of the grid's box from its centre, as a
    share of the amplitude.
    """
    x, y, z = places.clamp(-0.5, 0.5).unbind(dim=-1)
    front = ((y - SPINE) / (FRONT - SPINE)).clamp(0, 1)
    return ((math.pi * x).cos() * (math.pi / 2 * front).sin() * (math.pi * z).cos()).square()


def check_amplitude(grid: Grid, mm: float) -> None:
    """Raise ValueError unless no amplitude of up to so many mm folds the grid's object."""
    steepest = math.pi, math.pi / 2 / (FRONT - SPINE), math.pi  # of s along x, y, z, per box
    slope = sum(
        abs(d) * along / (n * step)
        for d, along, n, step in zip(DIRECTION, steepest, grid.size, grid.spacing, strict=True)
    )
    if not 0 <= mm * slope < 1:
        raise ValueError(
            f"Expected an amplitude of breathing from 0 to below {1 / slope:.3g} mm, beyond which "
            f"tissue of this grid could fold, got {mm:g}"
        )


def breathed(volume: Float[Tensor, "1 d h w"], grid: Grid, mm: float) -> Float[Tensor, "1 d h w"]:
    """Deform an object by an amplitude in mm; trilinear, second order in the voxel size. Voxels
    behind the spine keep their bits.

    Raises:
        ValueError: a negative amplitude, or one that could fold the object.
    """
    check_amplitude(grid, mm)
    step = mm * torch.tensor(DIRECTION, dtype=torch.float64) / torch.tensor(grid.spacing).double()
    sizes = torch.tensor(grid.size, dtype=torch.float64)
    rows, plane = math.floor((SPINE + 0.5) * grid.size[1] + 0.5), pixel_centres(grid.shape[1:])
    planes = []
    for k in range(grid.shape[0]):  # one by one, which bounds the memory
        index = torch.nn.functional.pad(plane[rows:], (0, 1), value=float(k))
        rest = index - step * share((index - grid.centre_index) / sizes)[..., None]
        points = normalised(rest, grid.shape).to(volume)
        planes.append(sample(volume[None], points[None, None])[0])
    return torch.cat([volume[:, :, :rows], torch.cat(planes, dim=1)], dim=2)


def breathing_views(
    A: Projector, volume: Float[Tensor, "1 d h w"], amplitudes_mm: Sequence[float]
) -> Float[Tensor, "1 m v u"]:
    """Views of an object, each of the object deformed by an amplitude of its own.

    Args:
        A: the operator on the volume's grid.
        volume: the object at rest.
        amplitudes_mm: amplitude of the object in each view, in mm; 0: at rest, empty: all at rest.

    Raises:
        ValueError: as `breathed`, or a projector that attenuates the object by a map, which does
            not breathe.
    """
    if any(amplitudes_mm) and A.mu_map() is not None:
        raise ValueError(
            "Breathing deforms the object and not its attenuation; expected a projector without "
            "a mu-map, got one with it"
        )
    views = A(volume[None])
    for mm in sorted(set(amplitudes_mm) - {0.0}):
        chosen = [view for view, own in enumerate(amplitudes_mm) if own == mm]
        moved = breathed(volume, A.grid, mm)[None]
        views = views.index_copy(2, torch.tensor(chosen), view_subset(A, chosen)(moved))
    return views[0]
