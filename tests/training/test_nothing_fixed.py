"""What a run does not change is not computed again: no pose gradients, no pictures, no cases, no
weights in a step.
"""

from collections import Counter
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from mvrecon.apps.config import compose
from mvrecon.apps.train import train
from mvrecon.core.parts import PROJECTORS
from mvrecon.data.dataset import SceneDataset
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.methods.method import build_method
from mvrecon.report.viz import review
from mvrecon.training import fit, tensorboard
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from tests.methods.learned.rig import small_rig

FORWARD, ADJOINT, POSES = (
    "mvrecon::project",
    "mvrecon::backproject",
    ("mvrecon::lines_vjp", "mvrecon::warp_vjp"),
)
PICTURES = ("planes", "projections", "views", "per_view", "weights")


class Kernels(TorchDispatchMode):
    """Counts the calls of this package's operators, those of backward passes among them."""

    def __init__(self):
        super().__init__()
        self.calls = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.calls[func.name()] += func.namespace == "mvrecon"
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def settings():
    return TrainSettings(**compose("experiment=smoke"))


def test_a_training_step_projects_as_often_as_the_method_without_pose_gradients(
    settings, tmp_path, monkeypatch
):
    steps = []
    with Kernels() as kernels:
        monkeypatch.setattr(
            ReconstructionModule, "on_train_batch_start", lambda *_: kernels.calls.clear()
        )
        monkeypatch.setattr(
            ReconstructionModule, "on_train_batch_end", lambda *_: steps.append(dict(kernels.calls))
        )
        fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)
    start, consistency = settings.method["start"], settings.method["consistency"]
    # A x of: each SIRT iteration of the start but the first, the start's residual and each
    # consistency step.
    # Back: of the adjoint with the rays' weights and of each consistency step's.
    forward = start - 1 + 1 + consistency + 1 + consistency
    # A^T of: each SIRT iteration, the start's residual without and with the rays' weights, the
    # longest stable step, and each consistency step. Back: of each consistency step's residual.
    adjoint = start + 2 + 1 + consistency + consistency
    assert len(steps) == settings.trainer["max_steps"]
    # The first step computes SIRT's weights, A 1 and A^T 1, which stay those of the operator.
    assert [step[FORWARD] for step in steps] == [forward + 1] + [forward] * (len(steps) - 1)
    assert [step[ADJOINT] for step in steps] == [adjoint + 1] + [adjoint] * (len(steps) - 1)
    assert not any(step.get(poses) for step in steps for poses in POSES)


@pytest.mark.parametrize("moves", [False, True])
def test_pose_gradients_are_computed_for_poses_that_require_them(moves, monkeypatch):
    monkeypatch.setattr(
        "mvrecon.kernels.rays.cpu.operators.lines_vjp",
        lambda volume, views, lines, *_: torch.zeros_like(lines),
    )
    grid, rig = small_rig()
    rig = Cameras(rig.source.clone().requires_grad_(moves), rig.origin, rig.u, rig.v, rig.shape)
    A = PROJECTORS.build("drr", grid=grid, cameras=rig, backend="cpu")
    x = torch.rand(1, 1, *grid.shape, requires_grad=True)
    with Kernels() as kernels:
        A(x).square().sum().backward()
    assert kernels.calls[POSES[0]] == moves and (rig.source.grad is not None) == moves


def test_pictures_are_rendered_only_at_validation_and_references_once(
    settings, tmp_path, monkeypatch
):
    happened, built = [], []

    def noted(kind, function):
        def wrapper(*args, **kwargs):
            happened.append(kind)
            return function(*args, **kwargs)

        return wrapper

    for name in PICTURES:
        monkeypatch.setattr(review, name, noted("pictures", lambda *_: np.zeros((2, 2, 3), "u1")))
    for name in ("training_step", "validation_step"):
        monkeypatch.setattr(
            ReconstructionModule, name, noted(name, getattr(ReconstructionModule, name))
        )
    monkeypatch.setattr(
        tensorboard,
        "build_method",
        lambda config: built.append(config["name"]) or build_method(config),
    )
    board = {
        "_target_": "mvrecon.training.tensorboard.TensorBoardReview",
        "every": 1,
        "cases": 2,
        "baselines": ["sirt"],
    }
    trainer = {**settings.trainer, "val_check_interval": 1, "num_sanity_val_steps": 0}
    settings = replace(settings, callbacks={"board": board}, trainer=trainer)
    fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)
    assert [kind for kind, _ in groupby(happened)] == [
        "training_step",
        "validation_step",
        "pictures",
    ] * 3
    assert built == ["sirt"]


def test_no_case_is_simulated_twice_for_any_number_of_methods(settings, tmp_path, monkeypatch):
    made, make = Counter(), SceneDataset.made

    def noted(self, item):
        made[self.seed, self.indices[item]] += 1
        return make(self, item)

    monkeypatch.setattr(SceneDataset, "made", noted)
    trainer = {**settings.trainer, "max_steps": 4}  # more than an epoch
    other = {"name": "world_unet", "widths": [4], "start": 2, "consistency": 0}
    train(
        replace(
            settings,
            compare={"other": other, "sirt": {"name": "sirt", "iterations": 2}},
            trainer=trainer,
        ),
        tmp_path,
    )
    assert set(made.values()) == {1} and len(made) == sum(settings.data["sizes"].values())
