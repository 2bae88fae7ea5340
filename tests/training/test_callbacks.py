"""What is logged beside the training: a support on the board, time and memory."""

from types import SimpleNamespace

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.training import fit, tensorboard
from mvrecon.training.callbacks import Clock
from mvrecon.training.settings import TrainSettings
from mvrecon.training.tensorboard import outlined


def test_an_outline_is_the_masks_outermost_voxels():
    volume, mask = torch.rand(7, 7, 7), torch.zeros(7, 7, 7, dtype=torch.bool)
    mask[0:4, 1:5, 2:6] = True
    shown = outlined(volume, mask, 9.0)
    assert torch.equal(shown[1:3, 2:4, 3:5], volume[1:3, 2:4, 3:5])
    assert torch.equal(shown[~mask], volume[~mask])
    assert (shown == 9).sum() == 4**3 - 2**3


@pytest.mark.parametrize("support", ["none", "hull"])
def test_the_board_shows_the_support_at_validation_and_names_the_method(
    support, tmp_path, monkeypatch
):
    shown, named = [], tensorboard.named
    monkeypatch.setattr(
        tensorboard, "named", lambda name, *rest: shown.append(name) or named(name, *rest)
    )
    settings = TrainSettings(**compose("experiment=smoke"))
    settings.method |= {"support": support}
    settings.trainer |= {"max_steps": 2}
    board = {
        "_target_": "mvrecon.training.tensorboard.TensorBoardReview",
        "baselines": [],
        "cases": 1,
    }
    settings.callbacks = {"board": board}
    fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)
    header = next(tmp_path.rglob("metrics.csv")).read_text().splitlines()[0]
    assert ("val/support_fraction" in header) == (support == "hull")
    assert len(list((tmp_path / "review").glob("*/planes.png"))) == 1
    assert set(shown) == {"cross_view_small"}, "its label in the table, not its class"


@pytest.mark.skipif(torch.cuda.is_available(), reason="the GPU's memory is told everywhere")
def test_without_memory_information_the_clock_logs_the_rest(monkeypatch):
    logged: dict[str, float] = {}

    class Module:
        def log_dict(self, figures, batch_size):
            logged.update(figures)

    for known in ({"time/peak_mb"}, set()):
        logged.clear()
        batch = {"views": torch.zeros(2, 1)}
        Clock().on_train_batch_end(SimpleNamespace(world_size=1), Module(), None, batch, 0)
        assert set(logged) == {"time/step_ms", "time/volumes_per_s", "time/seconds"} | known
        monkeypatch.setattr("mvrecon.core.machine.resource", None)
