"""A scene behind a detector: the shipped scenes' views bit for bit, and noise that depends only on
the case.
"""

import pickle

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.numbers import generator
from mvrecon.core.parts import CAMERAS, PROJECTORS, SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.dataset import SceneDataset
from mvrecon.data.hdf5 import write_volumes
from mvrecon.data.scenes.analytic import render
from mvrecon.data.scenes.sample import Scene
from mvrecon.data.volumes import Hdf5Volumes
from mvrecon.geometry.grid import Grid
from mvrecon.operators.drr import Drr
from tests.data.conftest import stored

GRID = Grid.centred((12, 12, 12), 10.0)
NAMES = ["ellipsoids", "derenzo", "shepp_logan", "quickstart"]


@pytest.fixture(scope="module")
def cameras():
    detector = {"pixels": [12, 16], "pixel_mm": 20.0}
    return CAMERAS.build("circular", n_views=3, sid=400.0, sdd=800.0, detector=detector)


@pytest.mark.parametrize("name", NAMES)
def test_drr_and_an_ideal_detector_reproduce_the_scene_s_views_exactly(name, cameras):
    settings = compose(f"scene={name}")
    scene = SCENES.from_config(settings["scene"])
    acquisition = Acquisition.of(settings["acquisition"])
    ours = Acquired(scene, settings["projector"], acquisition).sample(0, 3, GRID, cameras)
    plain = scene.sample(0, 3, GRID, cameras)
    for key in ("views", "volume", "inside"):
        assert torch.equal(getattr(ours, key), getattr(plain, key))
    if name in ("ellipsoids", "derenzo"):
        stored = render(scene.phantom(generator(3, 0), GRID), GRID, cameras, "stored")
        assert torch.equal(ours.views, stored.views) and torch.equal(ours.volume, stored.volume)


@pytest.mark.parametrize("name", NAMES)
def test_the_finer_object_matches_the_truth(name, cameras):
    """Its mean over the voxels of the grid is the truth, which twice as fine a grid has to the
    rounding: the same points.
    """
    scene = SCENES.from_config(compose(f"scene={name}")["scene"])
    truth = scene.sample(0, 3, GRID, cameras).volume
    fine = scene.finer(0, 3, GRID, cameras, 2)
    assert torch.allclose(torch.nn.functional.avg_pool3d(fine, 2), truth, atol=1e-5)


def test_noise_is_a_function_of_seed_and_index(cameras):
    scene = SCENES.build("ellipsoids", value=0.02)
    noisy = Acquired(scene, {"name": "drr"}, Acquisition(photons=1e4))
    first = noisy.sample(1, 0, GRID, cameras).views
    torch.manual_seed(7)
    noisy.sample(2, 0, GRID, cameras)
    again = pickle.loads(pickle.dumps(noisy)).sample(1, 0, GRID, cameras).views
    assert torch.equal(first, again)
    exact = scene.sample(1, 0, GRID, cameras).views
    other = Acquired(scene, {"name": "drr"}, Acquisition(photons=1e4, blur_mm=1e-6))
    assert torch.allclose(first, other.sample(1, 0, GRID, cameras).views, atol=0.05)
    noises = [first - exact, noisy.sample(1, 9, GRID, cameras).views - exact]
    assert 1e-3 < float(noises[0].std()) < 0.1 and not torch.equal(*noises)


class Forgetful(Scene):
    """A scene of a plugin: no method for finer grids, and a value from the global numbers."""

    data_range, unit, length = 1.0, "1/mm", None

    def sample(self, index, seed, grid, rig):
        value = float(torch.rand(()))
        return SCENES.build("ellipsoids", value=value).sample(index, seed, grid, rig)


class Silent(Drr):
    """A projector that does not say that it integrates along lines."""

    def forward(self, volume):
        return super().forward(volume)


def test_a_scene_with_global_random_numbers_has_the_same_object_on_both_grids(cameras, monkeypatch):
    monkeypatch.setattr(PROJECTORS, "_parts", {**PROJECTORS._parts, "silent": Silent})
    scene = Acquired(Forgetful(), {"name": "silent"})
    case = SceneDataset(scene, GRID, cameras, [1], seed=4, cache=False)[0]
    again = Drr(GRID, cameras)(case["volume"][None])[0]
    assert float(again.sum()) == pytest.approx(float(case["views"].sum()), rel=0.02)


def test_a_case_of_a_file_is_refined_in_the_position_of_its_truth(tmp_path, cameras):
    write_volumes(tmp_path / "heads.h5", stored(2))
    scene, grid = Hdf5Volumes(path=str(tmp_path / "heads.h5")), Grid.centred((8, 8, 8), 6.0)
    truth = scene.sample(1, 0, grid, cameras).volume
    for factor in (2, 3):
        fine = torch.nn.functional.avg_pool3d(scene.finer(1, 0, grid, cameras, factor), factor)
        assert torch.allclose(fine, truth, atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"fine": 2}, {"own_voxels": True}, {"vary": True}])
def test_a_case_of_a_file_has_the_same_truth_whatever_projects_it(tmp_path, cameras, options):
    """Bit by bit, of its own finer grid or another; the last is a varied copy."""
    write_volumes(tmp_path / "heads.h5", stored(2))
    scene, grid = (
        Hdf5Volumes(path=str(tmp_path / "heads.h5"), **options),
        Grid.centred(8, spacing=6.0),
    )
    index = 3 if options.get("vary") else 1
    plain = scene.sample(index, 0, grid, cameras)
    for fine in (2, 3, 4):
        acquisition = Acquisition(fine=fine, closed_form=False)
        case = Acquired(scene, {"name": "drr"}, acquisition).sample(index, 0, grid, cameras)
        assert torch.equal(case.volume, plain.volume) and torch.equal(case.inside, plain.inside)
        assert case.name == plain.name and case.views.shape == plain.views.shape
        assert (case.views - plain.views).norm() < 0.3 * plain.views.norm()
