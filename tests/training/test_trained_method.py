"""A trained method by its checkpoint: the same volume as its module's, and warnings where the scan
is another than in training.
"""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import mvrecon as mv
import mvrecon.apps.reconstruct
from mvrecon.core.parts import PROJECTORS
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras import files
from mvrecon.geometry.grid import Grid
from mvrecon.training.export import save_views
from mvrecon.training.trained_method import TrainedMethod
from tests.training.runs import call, trained_for_a_step

pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """One step of two methods: one that supports any rig, and one for its own rig only."""
    return trained_for_a_step(tmp_path_factory.mktemp("run"), "cross_view_small", "geometry_free")


def trained(A, views: torch.Tensor, *checkpoint: str) -> torch.Tensor:
    """The volume of a trained method by its checkpoint."""
    return TrainedMethod(*checkpoint)(views, A).volume


@pytest.fixture(scope="module")
def A(run: Path):
    """The operator of the training."""
    return mv.load(run).module.projector


@pytest.fixture(scope="module")
def views(A) -> torch.Tensor:
    """Views of a cube of half the training's greatest value."""
    cube = torch.zeros(1, 1, *A.grid.shape)
    cube[..., 4:12, 4:12, 4:12] = 0.5
    return A(cube)


@pytest.mark.parametrize("named", [True, False], ids=["the grid is named", "it is the training's"])
def test_a_checkpoint_reconstructs_a_scan_of_its_own_rig_as_its_module_does(
    run, A, views, tmp_path, named
):
    case = save_views(tmp_path, "scan", views[0, 0], "1")
    files.save(A.cameras, tmp_path / "rig.json")
    grid = (f"grid.size={list(A.grid.size)}", f"grid.spacing={list(A.grid.spacing)}")
    options = (
        f"views.path={case}/views.h5",
        f"camera.path={tmp_path}/rig.json",
        *(grid if named else ()),
        "method=trained",
        f"method.checkpoint={run}",
        f"out={tmp_path}/volume.nii.gz",
        f"hydra.run.dir={tmp_path}/run",
        "device=cpu",
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert call(mvrecon.apps.reconstruct, *options) == 0
    assert not [w for w in told if "trained" in str(w.message)]
    volume, grid = read_volume(tmp_path / "volume.nii.gz")
    with torch.inference_mode():
        expected = mv.load(run).module.eval()(views).volume[0, 0]
    assert torch.allclose(volume, expected, rtol=1e-4, atol=1e-5) and expected.max() > 0.1
    assert torch.allclose(grid.affine, A.grid.affine)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["method"] == "trained" and results["camera_weights"] == pytest.approx(
        mv.load(run).module.eval()(views).camera_weights[0].tolist(), abs=1e-4
    )


def test_another_rig_or_grid_is_reconstructed_with_a_warning(run, A, views):
    shifted = replace(A.cameras, source=A.cameras.source + torch.tensor([5.0, 0.0, 0.0]))
    other = PROJECTORS.build("drr", grid=A.grid, cameras=shifted)
    with pytest.warns(UserWarning, match="trained with another rig"):
        assert TrainedMethod(str(run))(views, other).volume.shape[2:] == A.grid.shape
    fine = Grid.centred(size=(20, 20, 20), spacing=6.4)
    other = PROJECTORS.build("drr", grid=fine, cameras=A.cameras)
    with pytest.warns(UserWarning, match=r"another grid .*\(16, 16, 16\).*got \(20, 20, 20\)"):
        assert TrainedMethod(str(run))(views, other).volume.shape[2:] == fine.shape


def test_views_in_another_unit_are_detected_by_the_data_range(run, A, views):
    with pytest.warns(UserWarning, match="another unit"):
        TrainedMethod(str(run))(1000 * views, A)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_case_in_another_unit_is_detected_beside_a_right_one(run, A, views, factor):
    """Too bright or too dim, before or after a case in the right unit; right ones are silent."""
    method = TrainedMethod(str(run))
    for pair in ([views, factor * views], [factor * views, views]):
        with pytest.warns(UserWarning, match="in 1 of 2 cases: do the views have another unit"):
            method(torch.cat(pair), A)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        method(torch.cat([views, views]), A)


def test_the_loaded_method_and_the_method_by_name_warn_in_the_same_words(run, A, views):
    def told(source: str, reconstruct) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            reconstruct()
        return [str(w.message).removeprefix(source) for w in caught if source in str(w.message)]

    rig = replace(A.cameras, source=A.cameras.source + torch.tensor([5.0, 0.0, 0.0]))
    fine, loaded = Grid.centred(size=(20, 20, 20), spacing=6.4), mv.load(run)
    other, bright = PROJECTORS.build("drr", grid=fine, cameras=rig), 1000 * views
    by_name = told(str(run), lambda: TrainedMethod(str(run))(bright, other))
    assert len(by_name) == 3  # rig, grid, values
    assert told("The trained cross_view", lambda: loaded(bright, rig, fine)) == by_name
    assert told("The trained cross_view", lambda: loaded(bright)) == [
        told(str(run), lambda: TrainedMethod(str(run))(bright, A))[-1]
    ]
    assert told("The trained cross_view", lambda: loaded(views, A.cameras, A.grid)) == []


def test_a_network_for_a_number_of_cameras_refuses_another(run, A, views):
    other = PROJECTORS.build("drr", grid=A.grid, cameras=A.cameras[:3])
    with (
        pytest.warns(UserWarning, match="trained with another rig"),
        pytest.raises(ValueError, match="Expected 4 cameras, got 3"),
    ):
        TrainedMethod(str(run), "geometry_free")(views[:, :, :3], other)
