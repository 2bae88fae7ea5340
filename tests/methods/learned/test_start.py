"""Classical starts: by number and by name, on a finer grid, and kept during a training."""

import pytest
import torch
from torch.nn.functional import avg_pool3d

from mvrecon.core.parts import METHODS
from mvrecon.geometry.grid import voxel_centres
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.learned import start as starts
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.start import ClassicalStart
from tests.methods.learned.rig import blob, small, small_projector

SIRT = {"name": "sirt", "iterations": 3}
LONG = {"name": "sirt", "iterations": 25, "momentum": True}


@pytest.fixture
def made(monkeypatch):
    """The views of every volume that a classical method has reconstructed."""
    views, build = [], METHODS.from_config

    def counted(config, A, own, **options):
        views.append(own)
        return build(config, A, own, **options)

    monkeypatch.setattr(METHODS, "from_config", counted)
    return views


def test_in_training_a_case_is_reconstructed_once_in_any_batch(made):
    projector = small_projector()
    geometry, views = Geometry.of(projector), projector(blob(projector, 3))
    views = views * torch.tensor([1.0, 2.0, 3.0])[:, None, None, None, None]
    start = ClassicalStart(SIRT)
    first = start(geometry, views, training=True).volume
    assert len(made) == 3
    assert torch.equal(start(geometry, views[[2, 0]], training=True).volume, first[[2, 0]])
    assert len(made) == 3
    assert torch.equal(start(geometry, views).volume, first) and len(made) == 6
    assert torch.allclose(first, sirt(projector, views, 3), rtol=1e-4, atol=1e-6)


def test_a_volume_that_does_not_fit_into_the_cache_is_recomputed(made, monkeypatch):
    projector = small_projector()
    geometry, views = Geometry.of(projector), projector(blob(projector, 2))
    views[1] *= 2
    monkeypatch.setattr(starts, "CACHE_BYTES", 4 * 12**3)
    start = ClassicalStart(SIRT)
    for _ in range(2):
        start(geometry, views, training=True)
    assert len(made) == 3


def test_training_from_a_finer_grid_uses_the_initial_volume_of_evaluation(made):
    projector = small_projector()
    model = small("cross_view", start={"name": "finer", "method": SIRT})
    views = projector(blob(projector))
    trained = model.train()(views, projector)
    trained.volume.sum().backward()
    again, evaluated = model(views, projector), model.eval()(views, projector)
    assert torch.equal(again.volume, trained.volume)
    assert torch.equal(evaluated.start, trained.start)
    plain = small("cross_view", start=3)(views, projector).start
    assert not torch.allclose(trained.start, plain, rtol=1e-2)
    assert len(made) == 4  # "finer" and its method, once in training and once in evaluation


def test_a_finer_grid_explains_views_that_the_grid_cannot():
    projector = small_projector(8, size=24, pixels=24)
    fine = projector.refined(4)
    places = voxel_centres(fine.grid) - torch.tensor([1.0, -0.5, 0.3], dtype=torch.float64)
    shells = (places.norm(dim=-1) < 16.0).float() + (places.norm(dim=-1) < 8.0).float()
    views = fine(shells[None, None])
    geometry, expected = Geometry.of(projector), projector(avg_pool3d(shells[None, None], 4))
    x, missed = ClassicalStart(LONG | {"finer_grid": 2})(geometry, views)
    assert (views - missed - expected).norm() < 0.75 * (views - expected).norm()
    # the volume's residual of these views is that on the finer grid of the measured ones
    two = projector.refined(2)
    residual = views - two(sirt(two, views, 25, momentum=True))
    assert torch.allclose(views - missed - projector(x), residual, atol=1e-3 * views.max().item())


def test_the_residual_views_of_a_finer_grid_are_cached_with_the_volume(made):
    projector = small_projector()
    geometry, views = Geometry.of(projector), projector(blob(projector, 2))
    start = ClassicalStart(SIRT | {"finer_grid": 2})
    first, again = (start(geometry, views, training=True) for _ in range(2))
    assert len(made) == 2
    assert all(torch.equal(*pair) for pair in zip(first, again, strict=True))


@pytest.mark.parametrize("number", [0, 1.5, "two"])
def test_a_refinement_factor_is_an_integer(number):
    with pytest.raises(ValueError, match="whole number of at least 1"):
        ClassicalStart(SIRT | {"finer_grid": number})


@pytest.mark.parametrize("name", ["cross_view", "world_unet"])
def test_counts_are_refused_for_residual_views(name):
    options = {"start": SIRT | {"finer_grid": 2}, "consistency": {"steps": 1, "noise": "poisson"}}
    with pytest.raises(ValueError, match="line integrals.* got counts"):
        small(name, **options)
