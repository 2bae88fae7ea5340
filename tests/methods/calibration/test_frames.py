"""Shifts of gated frames from their counts, which are Poisson numbers of closed-form integrals."""

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.methods.calibration.frames import frame_shifts
from mvrecon.operators.drr import Drr
from mvrecon.operators.stacked import Stacked

RIG = circular(12, 300.0, 450.0, {"pixels": [28, 28], "pixel_mm": 7.0})
GRID = Grid.centred(24, spacing=5.0)
SHIFTS = ((0.0, 0.0, 0.0), (3.0, -2.0, 7.0), (-1.0, 4.0, 12.0))
#: Centres, semi-axes and values of ellipsoids.
CENTRES = torch.tensor([[0.0, 0, 0], [16, -8, 6], [-13, 12, -11]])
SEMI_AXES = torch.tensor([[38.0, 34, 36], [9, 9, 11], [8, 8, 8]])


def counts_of(total: float, seed: int = 0, moving: int = 3) -> torch.Tensor:
    """All frames; the first ellipsoids, all but `moving`, stay at rest."""
    frames = []
    for shift in SHIFTS:
        centres = CENTRES.clone()
        centres[3 - moving :] += torch.tensor(shift)
        values, turns = torch.tensor([1.0, 5, 5]), torch.eye(3).expand(3, 3, 3)
        body = Phantom((Solids("ellipsoid", centres, turns, SEMI_AXES, values),))
        frames.append(body.integrals(*RIG.rays(), RIG.ray_extent))
    ideal = torch.cat(frames)[None, None].float()
    noise = torch.Generator().manual_seed(seed)
    return torch.poisson(ideal * (total / ideal.sum()), generator=noise)


def estimate(counts: torch.Tensor, grid: Grid = GRID, **options):
    def operator_of(shifts):
        return Stacked([Drr(grid, RIG.moved(torch.eye(3), -shift)) for shift in shifts])

    return frame_shifts(operator_of, grid, counts, [12] * 3, **options)


def turned() -> Grid:
    affine = torch.eye(4).double()
    affine[:3, :3] = euler_rotation(torch.tensor([20.0, 10.0, 30.0])).double()
    affine[:3, :3] *= torch.tensor([5.0, 6.0, 4.5])
    middle = torch.tensor([11.0, 10.0, 12.5]).double()
    affine[:3, 3] = -affine[:3, :3] @ middle
    return Grid((26, 21, 23), affine)


@pytest.mark.parametrize("grid", [GRID, turned()], ids=["straight", "turned"])
@pytest.mark.filterwarnings("error:Expected frames")
def test_shifts_of_many_counts_are_a_fiftieth_of_a_voxel_off(grid):
    """Also tried, with pinholes: attenuation that moves along, voxels of 6 x 5 x 8 mm, 2 to 8
    iterations of OSEM, a ball alone. Activity that leaves the field (25 mm) is 0.4 mm off.
    """
    found = estimate(counts_of(3e7), grid)
    assert found.settled
    assert (found.shift_mm - torch.tensor(SHIFTS)).abs().max() < 0.1


def test_errors_are_those_of_poisson_noise():
    """Over seeds, chi^2 of the six shifts is near six."""
    chi2 = []
    for seed in range(6):
        found = estimate(counts_of(1e5, seed))
        off = (found.shift_mm - torch.tensor(SHIFTS))[1:] / found.sigma_mm[1:]
        chi2.append(off.square().sum().item())
    assert 3 < sum(chi2) / 6 < 12


def test_a_background_is_not_followed():
    """Scatter that stays in place, half of the counts."""
    counts = counts_of(1e6)
    level = counts.mean().item()
    noise = torch.Generator().manual_seed(9)
    added = counts + torch.poisson(torch.full_like(counts, level), generator=noise)
    found = estimate(added, background=level)
    assert (found.shift_mm - torch.tensor(SHIFTS)).abs().max() < 0.4


def test_parts_that_move_alone_are_named():
    """Hot parts move in a body at rest: the shift is neither's."""
    with pytest.warns(UserWarning, match="moves as a whole"):
        estimate(counts_of(3e5, moving=2))


def test_bad_frames_are_refused():
    counts = counts_of(1e5)
    with pytest.raises(ValueError, match="at least two frames, 36 in all"):
        frame_shifts(lambda _: Drr(GRID, RIG), GRID, counts, [12, 12])
    empty = counts.clone()
    empty[:, :, 12:24] = 0
    with pytest.raises(ValueError, match="determine a shift"):
        estimate(empty)
