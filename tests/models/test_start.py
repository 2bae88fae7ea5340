"""Classical starts: what a training keeps of them, and what they do not depend on."""

import pytest
import torch

from mvrecon.models import start as starts
from mvrecon.models.cross_view.model import CrossView
from mvrecon.models.geometry import whole_geometry
from mvrecon.models.start import ClassicalStart
from mvrecon.parts import RECONSTRUCTORS
from mvrecon.reconstructors.iterative import sirt
from tests.models.cross_view.test_model import blob
from tests.models.rig import small_projector

SIRT = {"name": "sirt", "iterations": 3}


@pytest.fixture
def made(monkeypatch):
    """The views of every volume that a reconstructor has made."""
    views, build = [], RECONSTRUCTORS.from_config

    def counted(config, A, own, **options):
        views.append(own)
        return build(config, A, own, **options)

    monkeypatch.setattr(RECONSTRUCTORS, "from_config", counted)
    return views


def test_in_training_a_case_is_reconstructed_once_whatever_its_batch(made):
    projector = small_projector()
    geometry, views = whole_geometry(projector), projector(blob(projector, 3))
    views = views * torch.tensor([1.0, 2.0, 3.0])[:, None, None, None, None]
    start = ClassicalStart(SIRT)
    first = start(geometry, views, training=True)
    assert len(made) == 3
    assert torch.equal(start(geometry, views[[2, 0]], training=True), first[[2, 0]])
    assert len(made) == 3
    assert torch.equal(start(geometry, views), first) and len(made) == 6
    assert torch.allclose(first, sirt(projector, views, 3), rtol=1e-4, atol=1e-6)


def test_what_there_is_no_room_for_is_made_anew(made, monkeypatch):
    projector = small_projector()
    geometry, views = whole_geometry(projector), projector(blob(projector, 2))
    views[1] *= 2
    monkeypatch.setattr(starts, "ROOM", 4 * 12**3)
    start = ClassicalStart(SIRT)
    for _ in range(2):
        start(geometry, views, training=True)
    assert len(made) == 3


def test_a_model_trains_from_a_finer_grid_and_its_start_is_that_of_evaluation(made):
    projector = small_projector()
    finer = {"name": "finer", "reconstructor": SIRT}
    torch.manual_seed(0)
    model, views = CrossView(projector, [{"widths": [4]}], finer), projector(blob(projector))
    trained = model.train()(views)
    trained.volume.sum().backward()
    again, evaluated = model(views), model.eval()(views)
    assert torch.equal(again.volume, trained.volume)
    assert torch.equal(evaluated.start, trained.start)
    assert not torch.allclose(trained.start, CrossView(projector, start=3)(views).start, rtol=1e-2)
    assert len(made) == 4  # "finer" and its method, once in training and once in evaluation
