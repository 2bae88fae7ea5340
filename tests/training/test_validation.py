"""Figures of a validation: means over its cases, of which a failed one cannot be left out."""

import math
from dataclasses import fields, replace

import lightning.pytorch as L
import pytest
import torch
from torch.utils.data import DataLoader

from mvrecon.apps.config import compose
from mvrecon.methods.calibration import self_alignment
from mvrecon.methods.method import Alignment
from mvrecon.training import fit
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.settings import TrainSettings
from mvrecon.training.trained import load

ALIGNED = (
    "experiment=smoke",
    "method=aligned",
    "method@method.method=uncertain",
    "method@method.method.method=cross_view_small",
    "acquisition.disturbed={views: 1, shift_px: 1.0, gain: 0.05, probability: 0.7}",
    "data.sizes.val=3",
)


def validated(module, cases, batch_size):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = L.Trainer(accelerator="cpu", devices=1, **quiet)
    (figures,) = trainer.validate(module, DataLoader(cases, batch_size), verbose=False)
    return figures


@pytest.fixture(scope="module")
def validation():
    """A method that estimates its error and the shifts and gains of cameras, and three cases; few
    iterations of its alignment, which took nearly all of the time.
    """
    torch.manual_seed(0)
    settings = TrainSettings(**compose(*ALIGNED))
    data = fit.build_data(settings)
    data.setup("validate")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(self_alignment, "ITERATIONS_FROM_ZERO", 3)
        yield fit.build_module(settings, settings.method, data.data_range), data.sets["val"]


def test_no_figure_depends_on_the_batch_size(validation):
    module, cases = validation
    alone = validated(module, cases, 1)
    kinds = ("quality_predicted", "quality_coverage", "quality_wrong", "cameras_auc")
    assert all(any(f"val/{kind}" in name for name in alone) for kind in kinds), sorted(alone)
    for size in (2, 3):
        assert validated(module, cases, size) == pytest.approx(alone, rel=1e-4, nan_ok=True)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_failed_volume_invalidates_the_mean_but_an_empty_scene_does_not(
    validation, bad, monkeypatch
):
    module, cases = validation
    some = [dict(cases[k]) for k in range(3)]
    whole = validated(module, some, 2)
    some[1]["inside"] = torch.zeros_like(some[1]["inside"])
    empty = validated(module, some, 2)
    assert empty["val/psnr"] == pytest.approx(whole["val/psnr"], rel=1e-5)
    assert math.isfinite(empty["val/psnr_inside"])

    make = module.method.forward

    def spoilt(views, A):
        out = make(views, A)
        out.volume[0, 0, 0, 0, 0] = bad
        return out

    monkeypatch.setattr(module.method, "forward", spoilt)
    failed = validated(module, some, 2)
    names = ("psnr", "ssim", "nrmse", "psnr_inside", "view_nrmse")
    assert all(math.isnan(failed[f"val/{name}"]) for name in names)


def test_weights_that_fail_in_one_case_are_never_the_best(tmp_path, monkeypatch):
    judge = ReconstructionModule.validation_step

    def spoilt_at_step_2(module, batch, index):
        make = module.method.forward

        def perfect_but_for_one(views, A):
            volume = batch["volume"].clone()
            volume[0, 0, 0, 0, 0] = math.nan
            return replace(make(views, A), volume=volume)

        with monkeypatch.context() as patch:
            if module.global_step == 2:
                patch.setattr(module.method, "forward", perfect_but_for_one)
            return judge(module, batch, index)

    monkeypatch.setattr(ReconstructionModule, "validation_step", spoilt_at_step_2)
    settings = TrainSettings(**compose("experiment=smoke", "callbacks=best", "~callbacks.board"))
    settings.trainer |= {"val_check_interval": 1, "num_sanity_val_steps": 0}
    fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)
    assert load(tmp_path / "best" / "best.ckpt").steps in (1, 3)


def test_splitting_a_batch_and_joining_it_is_the_identity(validation):
    module, cases = validation
    batch = next(iter(DataLoader(cases, 3)))
    with torch.no_grad():
        out = module(batch["views"], module.operator(batch))
    parts = out.split()
    assert len(parts) == 3 and all(len(part.volume) == 1 for part in parts)
    for field in fields(out):
        whole = getattr(out, field.name)
        values = [getattr(part, field.name) for part in parts]
        if whole is None or field.name == "visible":  # of all cases
            assert all(value is whole for value in values)
        elif field.name == "alignment":
            again = Alignment.joined(values).tensors()
            torch.testing.assert_close(again, whole.tensors(), rtol=0, atol=0)
        else:
            torch.testing.assert_close(torch.cat(values), whole, rtol=0, atol=0)
