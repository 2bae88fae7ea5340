"""A trained method from the path of its checkpoint or of its run."""

from pathlib import Path

import pytest
import torch
import yaml

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.core.parts import SCENES
from mvrecon.training import checkpoints, fit
from mvrecon.training.settings import TrainSettings
from mvrecon.training.trained import shipped_weights
from tests.training.runs import trained_for_a_step


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of one step; its other method, SIRT, learns nothing and has no checkpoint."""
    place = tmp_path_factory.mktemp("run")
    return trained_for_a_step(
        place, "cross_view_small", options=["callbacks=best", "~callbacks.board"]
    )


def test_a_run_folder_and_its_checkpoint_are_one_method(run: Path):
    first, second = mv.load(run), mv.load(checkpoints.finished(run, "cross_view_small"))
    third = mv.load(str(run), "cross_view_small")
    weights = first.module.state_dict()
    for other in (second, third):
        assert all(torch.equal(weights[k], v) for k, v in other.module.state_dict().items())
    A = first.module.projector
    assert first.module(torch.zeros(1, 1, *A.range_shape)).volume.shape[2:] == A.domain_shape


def test_a_trained_method_is_called_with_views_and_with_another_rig_and_grid(run: Path):
    """The training's rig and grid give the same bits; others give their own shape."""
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
    with pytest.raises(ValueError, match=r"use x\[None, None\]"):
        trained(views[0, 0])


RIG = {"pixels": [32, 48], "sid": [700.0, 1300.0], "magnification": [1.3, 1.8]}


@pytest.fixture(scope="module", params=shipped_weights())
def shipped(request):
    """Shipped weights, a grid of their training, and a rig that the training did not contain."""
    grid = mv.Grid.centred(size=(32, 32, 32), spacing=(16.0, 10.0, 12.0))
    cameras = mv.random_rig(n_views=[6, 14], field_mm=[576.0, 640.0], seed=104, **RIG)
    return mv.load(request.param), grid, cameras


def test_shipped_weights_improve_on_the_initial_volume(shipped):
    """Of a phantom unlike the training data; views may be wrong."""
    trained, grid, cameras = shipped
    scan = SCENES.build("ellipsoids", value=0.02).sample(0, 0, grid, cameras)
    A, views = mv.Drr(grid, cameras), scan.views[None].clone()
    for shifted in (0, 2):
        error = (trained(views, cameras, grid) - scan.volume).norm()
        start = mv.sirt(A, views, 12, momentum=True)
        assert error < 0.9 * (start - scan.volume).norm()
        views[:, :, shifted] = 1.05 * views[:, :, shifted].roll(1, -1)


def test_the_initial_volume_is_returned_if_it_predicts_held_out_views_better(shipped):
    """Of a metal rod in water, which the network blurs."""
    trained, grid, cameras = shipped
    volume = torch.zeros(1, 1, *grid.shape)
    volume[..., 6:26, 6:26, 6:26] = 0.02
    volume[..., 10:12, 8:24, 10:12] = 0.4
    A = mv.Drr(grid, cameras)
    start = mv.sirt(A, A(volume), 12, momentum=True)
    alone = trained(A(volume), cameras, grid, fallback=False)
    assert (alone - volume).norm() > 1.02 * (start - volume).norm()
    with pytest.warns(UserWarning, match="left-out views worse than its classical start"):
        kept = trained(A(volume), cameras, grid)
    assert (kept - volume).norm() < 1.001 * (start - volume).norm()


def test_a_method_missing_from_a_run_is_named(run: Path):
    with pytest.raises(LookupError, match="no method 'unet'. It has cross_view_small"):
        mv.load(run, "unet")
    with pytest.raises(FileNotFoundError, match="sirt.*did the training of"):
        mv.load(run, "sirt")
    with pytest.raises(FileNotFoundError, match="No checkpoint or run folder"):
        mv.load(run / "nowhere")


def test_a_grid_by_its_shape_is_refused_where_the_order_of_the_axes_matters(run: Path):
    """A shape (z, y, x) is no size (x, y, z): of a cube, or of cubic voxels, it is clear."""
    settings = yaml.safe_load((run / "config.yaml").read_text())
    spacing = [1.0, 2.0, 3.0]
    settings["grid"] = {"shape": [16, 16, 16], "spacing": spacing}
    assert fit.build_data(TrainSettings(**settings)).grid.spacing == tuple(spacing)
    settings["grid"] = {"shape": [4, 6, 8], "spacing": 2.0}
    assert fit.build_data(TrainSettings(**settings)).grid.shape == (4, 6, 8)
    settings["grid"] = {"shape": [4, 6, 8], "spacing": spacing}
    with pytest.raises(ValueError, match=r"expected size=\(8, 6, 4\)"):
        fit.build_data(TrainSettings(**settings))


def test_a_method_can_start_from_the_weights_of_another_on_any_rig(
    run: Path, tmp_path, monkeypatch
):
    """`init_from`, once; a resumed run keeps its own weights. Those of another method are
    refused.
    """
    options = ("experiment=smoke", "camera.n_views=5", f"init_from={run}", "seed=7")
    settings, weights = TrainSettings(**compose(*options)), mv.load(run).module.method.state_dict()
    begun: list[dict[str, torch.Tensor]] = []

    class Trainer:
        loggers, is_global_zero, callbacks = (), False, ()
        max_steps, max_epochs, global_step, current_epoch = 1, None, 1, 0
        save_checkpoint = staticmethod(lambda path: None)

        def fit(self, module, **_):
            begun.append(module.method.state_dict())

    monkeypatch.setattr(fit, "build_trainer", lambda *_: Trainer())
    fit.fit("cross_view_small", settings, fit.build_data(settings), tmp_path)
    assert all(torch.equal(begun[0][name], value) for name, value in weights.items())
    other = TrainSettings(**compose(*options, "method=world_unet"))
    with pytest.raises(ValueError, match="weights of the same method.*'world_unet'"):
        fit.fit("world_unet", other, fit.build_data(other), tmp_path)


def test_the_checkpoint_of_the_best_validation_is_kept(run: Path):
    """By `val/psnr`; of one validation it is the last step's."""
    best, last = mv.load(run / "best" / "best.ckpt"), mv.load(run)
    assert best.steps == last.steps == 1
    weights = last.module.state_dict()
    assert all(torch.equal(weights[k], v) for k, v in best.module.state_dict().items())
    state = torch.load(run / "best" / "best.ckpt")["callbacks"]
    (kept,) = (value for key, value in state.items() if key.startswith("ModelCheckpoint"))
    assert kept["monitor"] == "val/psnr" and kept["best_model_score"] > 0
