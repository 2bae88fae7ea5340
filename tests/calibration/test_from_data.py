"""A misaligned rig comes back from its views alone."""

from functools import partial

import pytest
import torch

from mvrecon.calibration.from_data import shared_misalignment, view_shifts, without_motion
from mvrecon.cameras.misalignment import Misalignment, misaligned
from mvrecon.cameras.rigs import circular
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.projectors.drr import Drr

GRID = Grid.centred(24, spacing=4.0)
RIG = circular(16, 400.0, 600.0, {"pixels": [24, 32], "pixel_mm": 6.0})
BLOBS = [
    ((15.0, 5.0, -12.0), 1.0, 7.0),
    ((-10.0, 18.0, 6.0), 0.6, 6.0),
    ((4.0, -14.0, 16.0), 0.7, 6.0),
    ((-15.0, -15.0, -15.0), 0.8, 7.0),
]


def measured(by: Misalignment, photons: float | None = None) -> torch.Tensor:
    """Views of smooth blobs, line integrals up to about 3, with the noise of so many photons."""
    centres = voxel_centres(GRID)
    x = sum(
        weight * torch.exp(-((centres - torch.tensor(place)) ** 2).sum(-1) / (2 * width**2))
        for place, weight, width in BLOBS
    )
    y = Drr(GRID, misaligned(RIG, by))(0.1 * x.float()[None, None])
    if photons is not None:
        rng = torch.Generator().manual_seed(0)
        y = -torch.log(torch.poisson(photons * torch.exp(-y), generator=rng).clamp_min(1) / photons)
    return y


def test_a_shared_offset_and_tilt_come_back():
    """To 0.05 pixels and 0.02 degrees."""
    truth = Misalignment.none(1)
    truth.offset_px[0, 0], truth.tilt_degrees[0, 2] = 1.3, 0.7
    estimate = shared_misalignment(partial(Drr, GRID), RIG, measured(truth), rounds=4)
    got = estimate.misalignment
    assert abs(got.offset_px[0, 0].item() - 1.3) < 0.05
    assert abs(got.tilt_degrees[0, 2].item() - 0.7) < 0.02
    assert estimate.residual[-1] < 0.1 * estimate.residual[0]


@pytest.mark.parametrize(("photons", "bound"), [(None, 0.05), (1e4, 0.2)])
def test_shifts_of_single_views_come_back_but_for_a_motion_of_the_object(photons, bound):
    rng = torch.Generator().manual_seed(3)
    shifts = without_motion(RIG, 0.7 * torch.randn(16, 2, generator=rng, dtype=torch.float64))
    views = measured(Misalignment.none(16)._replace(offset_px=shifts), photons)
    got = view_shifts(partial(Drr, GRID), RIG, views, rounds=15).misalignment.offset_px
    assert (got - shifts).square().mean().sqrt() < bound


def test_a_moved_object_is_no_misalignment():
    move = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    shift = (RIG.project(move[None]) - RIG.project(torch.zeros(1, 3).double()))[:, 0, :2]
    assert without_motion(RIG, shift).norm() < 0.01 * shift.norm()


def test_nothing_is_misaligned_by_nothing():
    rig = misaligned(RIG, Misalignment.none(16))
    assert torch.allclose(rig.origin, RIG.origin) and torch.allclose(rig.u, RIG.u)


@pytest.mark.door
def test_unknown_freedoms_are_named():
    """A calibration of a freedom that does not exist is an error that names the nearest."""
    with pytest.raises(ValueError, match="'offset_x'; did you mean 'offset_"):
        shared_misalignment(partial(Drr, GRID), RIG, torch.zeros(1, 1, 16, 24, 32), ["offset_x"])
