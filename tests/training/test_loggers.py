"""TensorBoard: invalid numbers and pictures, and logs of a resumed run."""

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mvrecon.geometry.grid import Grid
from mvrecon.report.viz import review
from mvrecon.training.callbacks import TensorBoard

VOLUMES = {
    "one voxel": torch.rand(1, 1, 1),
    "many": torch.rand(2, 3, 1500),
    "NaN": torch.cat([torch.rand(3, 4, 4), torch.full((1, 4, 4), torch.nan)]),
    "negative": -torch.rand(4, 4, 4),
    "zero": torch.zeros(4, 4, 4),
}


def test_a_resumed_run_logs_steps_after_its_checkpoint_once(tmp_path):
    """The board shows the steps that a resumed run logs again once, with their new values, NaN
    among them or not.
    """
    board = TensorBoard(str(tmp_path))
    for step in range(6):
        board.experiment.add_scalar("loss", torch.nan if step == 1 else float(step), step)
    board.finalize("failed")
    again = TensorBoard(str(tmp_path))
    again.rewind(3)
    for step in (3, 4):
        again.experiment.add_scalar("loss", 10.0 + step, step)
    again.finalize("success")
    events = EventAccumulator(str(tmp_path)).Reload().Scalars("loss")
    finite = [(event.step, event.value) for event in events if np.isfinite(event.value)]
    assert finite == [(0, 0.0), (2, 2.0), (3, 13.0), (4, 14.0)]


@pytest.mark.parametrize("name", VOLUMES)
def test_the_board_shows_any_volume(name, tmp_path):
    x = VOLUMES[name]
    case = review.CaseSheets(name, Grid.centred(shape=x.shape, spacing=1.0), 1.0)
    pictures = {
        "planes": review.planes(case, x, {"x": x}),
        "views": review.views(x.nan_to_num(), x),
    }
    board = TensorBoard(str(tmp_path))
    for tag, picture in pictures.items():
        board.experiment.add_image(tag, picture, 0, dataformats="HWC")
    board.experiment.add_histogram("zeros", torch.zeros(1), 0)
    board.finalize("success")
    shown = EventAccumulator(str(tmp_path)).Reload()
    assert set(shown.Tags()["images"]) == set(pictures) and shown.Tags()["histograms"] == ["zeros"]
    for tag, picture in pictures.items():
        assert (shown.Images(tag)[0].height, shown.Images(tag)[0].width) == picture.shape[:2]


def test_the_board_shows_results_first_and_no_epoch(tmp_path):
    board = TensorBoard(str(tmp_path))
    logged = {
        "loss/total": 1.0,
        "val/psnr": 30.0,
        "val/loss_total": 2.0,
        "epoch": 1,
        "lr-Adam": 0.1,
    }
    board.log_metrics(logged, 5)
    board.finalize("success")
    tags = EventAccumulator(str(tmp_path)).Reload().Tags()["scalars"]
    assert sorted(tags) == [
        "figures/psnr",
        "loss/total",
        "loss_validation/total",
        "optimizer/lr-Adam",
    ]
