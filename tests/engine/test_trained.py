"""A trained method from the path of its checkpoint or of its run."""

from pathlib import Path

import pytest
import torch
import yaml

import mvrecon as mv
from mvrecon.engine import checkpoints, fit
from tests.engine.runs import trained_for_a_step


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of one step; its other method, SIRT, learns nothing and has no checkpoint."""
    return trained_for_a_step(tmp_path_factory.mktemp("run"), "cross_view")


def test_a_run_folder_and_its_checkpoint_are_one_method(run: Path):
    first, second = mv.load(run), mv.load(checkpoints.finished(run, "cross_view"))
    third = mv.load(str(run), "cross_view")
    weights = first.module.state_dict()
    for other in (second, third):
        assert all(torch.equal(weights[k], v) for k, v in other.module.state_dict().items())
    A = first.module.projector
    assert first.module(torch.zeros(1, 1, *A.range_shape)).volume.shape[2:] == A.domain_shape


def test_a_trained_method_is_called_with_views_and_with_another_rig_and_grid(run: Path):
    """The training's own rig and grid give the same bits; others their own shape."""
    trained = mv.load(str(run))
    A = trained.module.projector
    views = A(torch.rand(1, 1, *A.domain_shape, generator=torch.Generator().manual_seed(0)))
    expected = trained.module(views).volume
    assert torch.equal(trained(views), expected) and not trained(views).requires_grad
    assert torch.equal(trained(views, A.cameras, A.grid), expected)
    fewer = trained(views[:, :, ::2], A.cameras[::2])
    assert fewer.shape == expected.shape and fewer.isfinite().all()
    grid = mv.Grid.centred(size=(12, 14, 16), spacing=9.0)
    assert trained(views, grid=grid).shape[2:] == grid.shape
    with pytest.raises(ValueError, match=r"take x\[None, None\]"):
        trained(views[0, 0])


def test_a_method_that_a_run_does_not_have_is_named(run: Path):
    with pytest.raises(LookupError, match="no method 'unet'. It has cross_view"):
        mv.load(run, "unet")
    with pytest.raises(FileNotFoundError, match="sirt.*did the training of"):
        mv.load(run, "sirt")
    with pytest.raises(FileNotFoundError, match="No checkpoint or run folder"):
        mv.load(run / "nowhere")


def test_a_run_of_an_older_version_keeps_its_grid(run: Path, tmp_path: Path):
    """Settings that give a shape and one order alone mean what they meant; others are refused."""
    settings = yaml.safe_load((run / "config.yaml").read_text())
    spacing = [1.0, 2.0, 3.0]
    settings["grid"] = {"shape": [16, 16, 16], "spacing": spacing}
    assert fit.build_data(settings).grid.spacing == tuple(spacing)
    settings["grid"] = {"shape": [4, 6, 8], "spacing": 2.0}
    assert fit.build_data(settings).grid.shape == (4, 6, 8)
    settings["grid"] = {"shape": [4, 6, 8], "spacing": spacing}
    with pytest.raises(ValueError, match=r"expected size=\(8, 6, 4\)"):
        fit.build_data(settings)
