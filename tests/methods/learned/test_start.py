"""Classical starts: by number and by name, on a finer grid, and kept during a training."""

import pytest
import torch

from mvrecon.core.parts import METHODS
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.learned import start as starts
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.start import ClassicalStart
from tests.methods.learned.rig import blob, small, small_projector

SIRT = {"name": "sirt", "iterations": 3}


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
    first = start(geometry, views, training=True)
    assert len(made) == 3
    assert torch.equal(start(geometry, views[[2, 0]], training=True), first[[2, 0]])
    assert len(made) == 3
    assert torch.equal(start(geometry, views), first) and len(made) == 6
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
