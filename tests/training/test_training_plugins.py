"""What plugins bring to a training by name: optimisers, callbacks, loggers, terms of the loss,
figures of merit.
"""

import csv
import json

import pytest
import torch

import mvrecon.apps.train
from mvrecon import load
from mvrecon.apps.config import compose
from mvrecon.apps.settings import TrainSettings
from mvrecon.core import registry
from mvrecon.core.files.checks import Refused
from mvrecon.core.options import check
from mvrecon.core.parts import CALLBACKS, LOGGERS
from mvrecon.methods.method import Reconstruction
from mvrecon.report.result_table import table as report
from mvrecon.training.losses import ReconstructionLoss
from mvrecon.training.targets import instantiate
from tests.faults.plugins import plugin
from tests.training.lives import METHOD, OPTIONS

SOURCE = '''
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from mvrecon.report.metrics import Metric


class Signs(torch.optim.Optimizer):
    """Steps of one length along the sign of the gradient."""

    def __init__(self, parameters, lr):
        super().__init__(parameters, {"lr": lr})

    @torch.no_grad()
    def step(self, closure=None):
        loss = closure()
        for group in self.param_groups:
            for p in group["params"]:
                p -= group["lr"] * p.grad.sign()
        return loss


class Steps(Callback):
    """Writes the number of steps."""

    def __init__(self, dirpath):
        self.dirpath = dirpath

    def on_train_end(self, trainer, pl_module):
        with open(f"{self.dirpath}.txt", "w") as file:
            file.write(str(trainer.global_step))


class Second(CSVLogger):
    """Another table."""


def total(out, batch, data_range):
    """Squared error of the volume's sum, relative."""
    truth = batch["volume"].sum()
    return ((out.volume.sum() - truth) / truth).square()


@Metric(unit="1", column="sum ratio")
def ratio(volume, truth, inside, data_range):
    """The volume's sum by the true one."""
    return volume.sum() / truth.sum()
'''
POINTS = {
    "metric.sum_ratio": "stressed_training:ratio",
    "optimizer.signs": "stressed_training:Signs",
    "callback.steps": "stressed_training:Steps",
    "logger.second": "stressed_training:Second",
    "loss.sum_of_volume": "stressed_training:total",
}
CHOSEN = (
    "~optimizer",
    "+optimizer={name: signs, lr: 1e-3, schedule: constant}",
    "+callbacks.steps={name: steps, dirpath: counted}",
    "+logger.second={name: second}",
    "+loss.sum_of_volume=0.5",
    "data.sizes.test=2",
    "trainer.max_steps=3",
    "trainer.log_every_n_steps=1",
)


@pytest.fixture
def installed(tmp_path):
    with plugin(tmp_path / "site", POINTS, {"stressed_training": SOURCE}):
        yield


def test_a_training_supports_optimiser_callback_logger_and_loss_of_a_plugin(
    installed, tmp_path, monkeypatch
):
    """Every step has the plugin's length, its callback and logger write into the run folder, and
    the loss is ours and half of its term; without the plugin its checkpoint is refused.
    """
    settings = TrainSettings(**compose(*OPTIONS, *CHOSEN))
    check(settings, TrainSettings)
    mvrecon.apps.train.train(settings, tmp_path / "run")
    assert (tmp_path / "run" / "counted.txt").read_text() == "3"
    assert list((tmp_path / "run").rglob("lightning_logs/*/metrics.csv"))
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("loss/total")]
    for row in rows:
        ours = float(row["loss/volume"])
        assert float(row["loss/sum_of_volume"]) > 0
        assert float(row["loss/total"]) == pytest.approx(
            ours + 0.5 * float(row["loss/sum_of_volume"]), rel=1e-5
        )
    assert len(rows) == 3
    table = json.loads((tmp_path / "run" / "results.json").read_text())
    assert table["methods"][METHOD]["train_steps"] == 3
    ratios = table["methods"][METHOD]["sum_ratio"]["values"]
    assert len(ratios) == len(table["scenes"]) and all(0 < value < 5 for value in ratios)
    assert "brought" not in table and table["units"]["sum_ratio"] == table["units"]["ssim"] == "1"
    assert "sum\nratio" in [column.header for column in report(table).columns]
    monkeypatch.setattr(registry, "installed", lambda: ())
    with pytest.raises(Refused, match="No loss is named 'sum_of_volume' here; if a plugin"):
        load(tmp_path / "run")


def test_callbacks_loggers_and_losses_by_name_are_those_of_installed_plugins(installed, tmp_path):
    """A callback, a logger or a term of the loss by name is an installed plugin's or is refused,
    and its files stay in the run folder.
    """
    with pytest.raises(LookupError, match="No callback is named 'step'; did you mean 'steps'"):
        instantiate({"name": "step"}, tmp_path)
    with pytest.raises(LookupError, match="No logger is named 'os.system'"):
        instantiate({"name": "os.system"}, tmp_path, LOGGERS)
    with pytest.raises(TypeError, match="needs a _target_ or a name"):
        instantiate({"dirpath": "x"}, tmp_path, CALLBACKS)
    with pytest.raises(PermissionError, match="leads elsewhere"):
        instantiate({"name": "steps", "dirpath": "../x"}, tmp_path)
    with pytest.raises(TypeError, match="'sum_of_volum'; did you mean 'sum_of_volume'"):
        check({"loss": {"sum_of_volum": 1.0}}, TrainSettings)
    with pytest.raises(TypeError, match="expected float >= 0, got 'much'"):
        check({"loss": {"sum_of_volume": "much"}}, TrainSettings)
    with pytest.raises(TypeError, match="'sum_of_volum'; did you mean 'sum_of_volume'"):
        ReconstructionLoss(1.0, sum_of_volum=1.0)


def test_a_term_of_weight_zero_is_not_computed(installed):
    volume = torch.ones(1, 1, 2, 2, 2)
    batch = {"volume": 2 * volume, "views": torch.ones(1, 1, 1, 1, 1)}
    terms = ReconstructionLoss(1.0, sum_of_volume=0.5)(Reconstruction(volume), batch)
    assert float(terms["sum_of_volume"]) == 0.25 and float(terms["total"]) == 1.125
    assert "sum_of_volume" not in ReconstructionLoss(1.0, sum_of_volume=0.0)(
        Reconstruction(volume), batch
    )
