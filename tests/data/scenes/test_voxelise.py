import math
from dataclasses import replace

import pytest
import torch

import mvrecon.data.scenes.solids as voxelise_module
from mvrecon.data.scenes.solids import ROUND_AXES, Phantom, Solids, voxelise
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.geometry.rigid import random_rotation

UNIT_VOLUMES = {"ellipsoid": 4 / 3 * math.pi, "cylinder": 2 * math.pi, "box": 8.0}


def solids(kind, n=3, seed=0, spread=20.0):
    rng = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=rng, dtype=torch.float64)  # noqa: E731
    return Solids(
        kind,
        spread * (2 * draw(n, 3) - 1),
        random_rotation(rng, n),
        6 + 10 * draw(n, 3),
        draw(n) + 0.2,
    )


def skew_grid():
    grid = Grid.centred(size=(14, 11, 9), spacing=(6.0, 8.0, 9.0), centre=(3, -4, 5))
    affine = grid.affine.clone()
    affine[:3, :3] = random_rotation(torch.Generator().manual_seed(2)) @ affine[:3, :3]
    return Grid(grid.shape, affine)


@pytest.mark.pairwise(factor=[1, 2, 3], kind=ROUND_AXES)
def test_it_is_the_mean_over_the_finer_grid(kind, factor):
    grid, phantom = skew_grid(), Phantom((solids(kind, spread=40.0),))
    fine = phantom.values(voxel_centres(grid.refined(factor)))
    d, h, w = grid.shape
    mean = fine.reshape(d, factor, h, factor, w, factor).mean(dim=(1, 3, 5))
    assert mean.max() > 0
    torch.testing.assert_close(voxelise(phantom, grid, factor), mean.float())


@pytest.mark.parametrize("kind", ROUND_AXES)
def test_it_keeps_the_mass_and_converges(kind):
    grid, part = Grid.centred((24, 24, 24), 4.0), solids(kind)
    mass = (part.values * part.semi_axes.prod(dim=1)).sum().item() * UNIT_VOLUMES[kind]
    error = [
        abs(voxelise(Phantom((part,)), grid, f).double().sum().item() * 64 / mass - 1)
        for f in (1, 4, 12)
    ]
    assert error[1] < 0.01 and error[2] < 1e-3 and error[2] < error[0]


def test_voxels_converge_to_the_share_that_is_covered():
    grid, phantom = Grid.centred((12, 12, 12), 8.0), Phantom((solids("ellipsoid"),))
    truth = voxelise(phantom, grid, 16)
    errors = [(voxelise(phantom, grid, f) - truth).norm().item() for f in (1, 2, 4, 8)]
    assert all(finer < 0.6 * coarser for coarser, finer in zip(errors, errors[1:], strict=False))


def test_solids_are_truncated_at_the_grid():
    big = Phantom(
        (
            Solids(
                "box",
                torch.zeros(1, 3),
                torch.eye(3)[None],
                torch.full((1, 3), 500.0),
                torch.tensor([2.0]),
            ),
        )
    )
    assert (voxelise(big, Grid.centred(size=(6, 5, 4), spacing=3.0)) == 2).all()
    assert (voxelise(big, Grid.centred(size=(6, 5, 4), spacing=3.0, centre=(900, 0, 0))) == 0).all()


def test_results_do_not_depend_on_chunks(monkeypatch):
    grid, phantom = skew_grid(), Phantom((solids("cylinder"),))
    whole = voxelise(phantom, grid)
    monkeypatch.setattr("mvrecon.data.scenes.solids.BLOCK_POINTS", 200)
    assert torch.equal(voxelise(phantom, grid), whole)


def test_the_voxels_that_are_subdivided_grow_with_the_surface_not_with_the_volume(monkeypatch):
    ball, counts = solids("ellipsoid", n=1, spread=0.0), []
    ball = replace(ball, semi_axes=torch.full((1, 3), 25.0, dtype=torch.float64))

    def counted(p, *rest):
        counts.append(p.shape[1])
        return shares(p, *rest)

    shares = voxelise_module._shares
    monkeypatch.setattr(voxelise_module, "_shares", counted)
    for n in (16, 32, 64):
        voxelise(Phantom((ball,)), Grid.centred((n,) * 3, 64 / n))
    assert counts[0] < 16**3 / 2 and all(
        b < 4.8 * a for a, b in zip(counts, counts[1:], strict=False)
    ), counts


def test_a_factor_below_one_is_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        voxelise(Phantom((solids("box"),)), Grid.centred((4, 4, 4), 10.0), 0)


@pytest.mark.parametrize("kind", ROUND_AXES)
@pytest.mark.parametrize("away", [-500.0, 500.0])
def test_a_solid_beside_the_grid_leaves_it_empty(kind, away):
    """On either side; the upper one raised a RuntimeError."""
    beside = solids(kind)
    for axis in range(3):
        phantom = Phantom((beside,)).moved(torch.eye(3), away * torch.eye(3)[axis])
        assert not voxelise(phantom, Grid.centred(size=(6, 5, 4), spacing=3.0)).any()
