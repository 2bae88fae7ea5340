"""Cases with their own attenuation, and the experiments that write them to disk."""

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.core.numbers import generator
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.dataset import CaseStore, SceneDataset
from mvrecon.data.scenes.sample import Mixture
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.events.making import EventMaker
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.scenes.attenuating import attenuated_integrals
from mvrecon_spect.scenes.cardiac import RandomCardiac

GRID = Grid.centred(32, spacing=10.0, centre=(40, -40, 0))
RIG = dcspect80(pixels=8, columns=[2, 11], rows=[1])
SPECT = {"name": "spect", "diameter_mm": 2.3}


def seen(scene, acquisition=None, rig=RIG):
    return Acquired(scene, SPECT, acquisition).sample(5, 0, GRID, rig)


def test_the_attenuation_of_a_patient_affects_the_views():
    """Against the closed form; a quarter of the counts is left."""
    scene, fine = RandomCardiac(), Acquisition(fine=4)
    sample = seen(scene, fine)
    activity, matter = (f(generator(0, 5), GRID) for f in (scene.phantom, scene.matter))
    fine_rig = RIG.refined(8)
    rays = attenuated_integrals(activity, matter, *fine_rig.rays(), RIG.ray_extent)
    exact = 64 * torch.nn.functional.avg_pool2d(rays * Hole(2.3).weight(fine_rig), 8)
    error = (sample.views[0] - exact).norm() / exact.norm()
    assert error < 0.025
    assert sample.views.sum().item() == pytest.approx(exact.sum().item(), rel=5e-3)
    plain = seen(RandomCardiac(attenuates=False))
    assert (sample.views.sum() / plain.views.sum()).item() == pytest.approx(0.27, abs=0.02)
    mean = scene.maps(5, 0, GRID)["mu"].mean().item()
    assert sample.maps["mu"].mean().item() == pytest.approx(mean, rel=5e-3)
    assert not plain.maps["mu"].any()


def test_views_use_the_true_attenuation_whatever_the_reconstruction_assumes():
    wrong = Acquired(RandomCardiac(), {**SPECT, "mu": 0.05}).sample(5, 0, GRID, RIG)
    assert torch.equal(wrong.views, seen(RandomCardiac()).views)


def test_a_mixture_of_scenes_keeps_the_attenuation_of_a_patient():
    mixture = Mixture([{"name": "cardiac"}, {"name": "derenzo", "unit": "activity"}])
    patient = Acquired(mixture, SPECT).sample(4, 0, GRID, RIG)
    alone = Acquired(RandomCardiac(), SPECT).sample(4, 0, GRID, RIG)
    assert torch.equal(patient.views, alone.views)
    assert torch.equal(patient.maps["mu"], alone.maps["mu"])
    assert not Acquired(mixture, SPECT).sample(1, 0, GRID, RIG).maps


def test_views_from_the_finer_grid_are_near_those_in_closed_form():
    scene = RandomCardiac(attenuates=False)
    exact = seen(scene)
    near = seen(scene, Acquisition(closed_form=False))
    assert 0 < (near.views - exact.views).norm() / exact.views.norm() < 0.04
    assert near.volume.allclose(exact.volume, atol=1e-6) and near.name == exact.name
    assert torch.equal(near.inside, exact.inside)


def test_data_set_and_store_keep_the_attenuation_of_their_cases(tmp_path):
    scene = RandomCardiac()
    stored = Acquired(scene, SPECT, store=CaseStore(tmp_path, {"scene": "cardiac"}, scene))
    for _ in range(2):  # made, then read
        case = SceneDataset(stored, GRID, RIG, [5], 0, cache=False)[0]
        assert torch.equal(case["mu"], seen(scene).maps["mu"])


@pytest.mark.parametrize("name", ["events", "events_cardiac"])
def test_the_experiments_generate_events_of_realistic_size(name):
    small = ("grid.size=[16,16,16]", "camera.pixels=8", "+camera.columns=[3]", "events.angles=4")
    spacing = {"events": "16.0", "events_cardiac": "20.0"}[name]
    settings = compose(
        f"experiment={name}", *small, f"grid.spacing={spacing}", config_name="events"
    )
    maker = EventMaker.of(settings)
    event = maker(0)
    assert event["ideal"].shape == event["counts"].shape == (4, 8, 8)
    assert event["counts"].sum() == pytest.approx(5e5, abs=5 * 5e5**0.5)
    assert event["radon"].shape == (4, 16, 23)
    assert ("mu" in event) == (name == "events_cardiac")
    assert maker.columns[:6] == (
        "x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees",
    )  # fmt: skip
