"""Methods on a finer grid than the volume's."""

import pytest
import torch
from torch.nn.functional import avg_pool3d

import mvrecon as mv
from mvrecon.core.parts import METHODS
from mvrecon.geometry.grid import subdivided
from tests.methods.classical.methods import GRID, RIG, Dense, gap, projector, truth

SIRT = {"name": "sirt", "iterations": 20, "momentum": True}


def test_the_refined_operator_has_a_finer_grid_and_denser_rays():
    """On volumes of constant voxels siddon is exact on either grid; so it is with its weights."""
    thin, close = (mv.Drr(GRID, RIG, method="siddon", rays_per_pixel=rays) for rays in (1, 2))
    x = truth(thin)
    mask = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(0)) > 0.5
    for one, other in (
        (thin, close),
        (3 * thin, 3 * close),
        (thin.with_support(mask), close.with_support(mask)),
    ):
        fine = one.refined(2)
        assert fine.domain_shape == (12, 14, 16) and fine.range_shape == one.range_shape
        assert torch.allclose(fine(subdivided(x, 2)), other(x), rtol=1e-10)


def test_subdivided_voxels_average_to_the_coarse_ones_in_their_position():
    x = truth(projector())
    assert torch.allclose(avg_pool3d(subdivided(x, 3), 3), x, rtol=1e-12)
    centre = GRID.refined(3).to_world(torch.ones(3, dtype=torch.float64))
    assert torch.allclose(centre, GRID.to_world(torch.zeros(3, dtype=torch.float64)))


def test_finer_equals_the_method_on_the_finer_operator_within_the_support():
    A, fine = projector(), projector().refined(2)
    views, support = A(truth(A)), torch.zeros(A.domain_shape, dtype=torch.bool)
    support[1:5, 2:6, 1:7] = True
    volume = mv.finer(A, views, method=SIRT, support=support)
    own = mv.sirt(fine, views, 20, momentum=True, support=subdivided(support, 2))
    assert torch.equal(volume, avg_pool3d(own, 2)) and not volume[0, 0][~support].any()
    assert torch.equal(mv.finer(A, views, 1, SIRT), mv.sirt(A, views, 20, momentum=True))


def test_a_finer_grid_reduces_artefacts_from_unrepresentable_views():
    """Of a ball on a grid four times finer."""
    A = mv.Drr(
        mv.Grid.centred(16, spacing=4.0),
        mv.circular(8, 400.0, 600.0, {"pixels": [24, 24], "pixel_mm": 4.5}),
    )
    axes = torch.meshgrid(*[torch.arange(64) - 31.5] * 3, indexing="ij")
    ball = (sum(axis.square() for axis in axes) < 20.0**2).float()[None, None]
    views, x = A.refined(4)(ball), avg_pool3d(ball, 4)
    coarse, fine = (gap(mv.finer(A, views, factor, SIRT), x) for factor in (1, 2))
    assert fine < 0.85 * coarse


@pytest.mark.parametrize(
    ("A", "options", "error", "text"),
    [
        (projector(), {"fine": 0}, ValueError, "whole number of at least 1, got 0"),
        (projector(), {"method": {"name": "sart"}}, LookupError, "sart"),
        (projector(), {"method": {"name": "sirt", "iters": 2}}, TypeError, "iters"),
        (Dense(), {}, ValueError, "2 times finer, such as drr or radon, got Dense"),
    ],
)
def test_invalid_input_is_refused(A, options, error, text):
    views = torch.ones(1, 1, *A.range_shape)
    with pytest.raises(error, match=text):
        METHODS.build("finer", A, views, **options)
