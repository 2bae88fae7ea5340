"""Attenuation of each case's own in models, and the experiments that use it."""

import re
from functools import cache
from pathlib import Path

import pytest
import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.apps.reconstruct import run_reconstruction
from mvrecon.apps.settings import ReconstructSettings, SimulateSettings, TrainSettings
from mvrecon.apps.simulate import simulate
from mvrecon.core.options import check
from mvrecon.core.parts import METHODS
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import subdivided
from mvrecon.operators.selection import view_subset
from mvrecon.training.evaluation import evaluate
from mvrecon.training.fit import build_data, build_module
from mvrecon.training.module import build_projector
from mvrecon_spect.operators.matter import CaseAttenuation
from mvrecon_spect.operators.projector import Spect
from mvrecon_spect.scenes.cardiac import RandomCardiac
from mvrecon_spect.scenes.spect_ct import SpectCt

pytestmark = pytest.mark.usefixtures("blank_pictures")

#: A patient in 10 x 8 x 8 voxels, and networks of a few weights.
TINY = (
    "camera.pixels=8",
    "camera.columns=[3]",
    "compare.world_unet.widths=[2]",
    "compare.bsrem.iterations=1",
    "data.sizes={train: 2, val: 0, test: 2}",
)
SMALL, CUBE = "method=cross_view_small", ("grid.size=[8,8,8]", "grid.spacing=20")
GRIDS = {
    "dcspect_derenzo": (SMALL, *CUBE),
    "dcspect_derenzo_blurred": (SMALL, *CUBE),
    "dcspect_cardiac": (SMALL, "grid.size=[10,8,8]", "grid.spacing=32"),
    "dcspect_ct": (SMALL, "grid.size=[10,8,8]", "grid.spacing=32", "scene.iterations=4"),
    "dcspect_radon": (*CUBE, "method.n_cameras=4", "method.widths=[2]"),
}


@cache
def settings_of(name: str) -> dict:
    return compose(f"experiment={name}", *TINY, *GRIDS[name])


@cache
def data_of(name: str):
    data = build_data(TrainSettings(**settings_of(name)))
    data.setup("test")
    data.setup("fit")
    return data


@cache
def module_of(name: str, label: str):
    settings = TrainSettings(**settings_of(name))
    return build_module(settings, settings.methods()[label], 1.0)


def batch_of(name: str) -> dict:
    return next(iter(data_of(name).test_dataloader()))


@pytest.mark.parametrize("name", GRIDS)
def test_an_experiment_trains_a_step_and_evaluates_every_method(name: str):
    if name == "dcspect_radon" and "radon_unet" not in METHODS.names():
        pytest.skip("the plugin mvrecon-baselines is not installed")
    data, settings = data_of(name), settings_of(name)
    module, batch = module_of(name, settings["label"]), next(iter(data.train_dataloader()))
    module.terms(batch)["total"].backward()
    slopes = [p.grad for p in module.parameters() if p.grad is not None]
    assert any(slope.any() for slope in slopes) and all(s.isfinite().all() for s in slopes)
    check(settings, TrainSettings)  # as the app does before it starts
    modules = {label: module_of(name, label) for label in TrainSettings(**settings).methods()}
    A = build_projector(settings["grid"], settings["camera"], settings["projector"])
    scores = evaluate(
        {label: module.method for label, module in modules.items()},
        data.test_dataloader(),
        A,
        1.0,
        assumed={label: module.projector for label, module in modules.items()},
    )
    assert set(scores) == set(modules)
    assert all(
        0 < s["nrmse"] < 3 and 0 < s["view_nrmse"] < 2 for row in scores.values() for s in row
    )


def test_each_case_of_a_batch_is_reconstructed_with_its_own_attenuation():
    batch, module = batch_of("dcspect_cardiac"), module_of("dcspect_cardiac", "osem")
    made = module(batch["views"], module.operator(batch)).volume
    grid, cameras = module.projector.grid, module.projector.cameras
    for case in range(2):
        A = Spect(grid, cameras, mu=batch["mu"][case, 0])
        views = batch["views"][case : case + 1]
        assert torch.equal(made[case : case + 1], mv.osem(A, views, 1))
    assert not torch.equal(batch["mu"][0], batch["mu"][1])


@pytest.mark.parametrize("options", [{}, {"blur": True}, {"acceptance_degrees": 20.0}], ids=str)
def test_the_operator_of_a_case_is_that_of_its_map(options: dict):
    """To the bit, also when the transmission is cached, for subsets and on a finer grid."""
    grid, rig = mv.Grid.centred(size=(7, 6, 5), spacing=24.0), dcspect80(pixels=8, columns=[0, 5])
    maps, x = 0.01 * torch.rand(2, 1, *grid.shape), torch.rand(1, 1, *grid.shape)
    of_cases = Spect(grid, rig, mu="case", **options).for_case({"mu": maps})
    pairs = [
        (of_cases.of_sample(n), Spect(grid, rig, mu=mu[0], **options)) for n, mu in enumerate(maps)
    ]
    for _ in range(3):
        for A, B in pairs:
            views = B(x)
            assert torch.equal(A(x), views) and torch.equal(A.T(views), B.T(views))
    for A, B in pairs:
        assert torch.equal(view_subset(A, [3, 1])(x), view_subset(B, [3, 1])(x))
        assert torch.equal(A.mu_map(), B.mu_map())
        if "refine" in B.capabilities:
            finer = subdivided(x[0, 0], 2)[None, None]
            assert torch.equal(A.refined(2)(finer), B.refined(2)(finer))


def test_a_method_may_use_another_attenuation_than_the_views():
    batch = batch_of("dcspect_ct")
    plain = module_of("dcspect_ct", "osem_none")
    A = Spect(plain.projector.grid, plain.projector.cameras)
    made = plain(batch["views"], plain.operator(batch)).volume
    assert torch.equal(made, mv.osem(A, batch["views"], 1))
    maps = [
        CaseAttenuation.of(mu).maps_of(batch, A.grid)[0]
        for mu in ("measured", {"of": "measured", "shift_mm": [32, 0, 0]})
    ]
    assert torch.equal(maps[0], batch["mu_measured"][0, 0])
    torch.testing.assert_close(maps[1][..., 1:], maps[0][..., :-1])
    assert not maps[1][..., 0].any()


def test_a_scan_measures_the_attenuation_of_the_patient():
    """Mean over the torso to 3 %, each case with its own noise, the same at every call."""
    batch, scene = batch_of("dcspect_ct"), data_of("dcspect_ct").scenes["test"]
    true, known = batch["mu"], batch["mu_measured"]
    assert known.sum().item() == pytest.approx(true.sum().item(), rel=0.03)
    assert (known - true).norm() < 0.35 * true.norm()
    again = scene.sample(0, 0, data_of("dcspect_ct").grid, data_of("dcspect_ct").cameras)
    assert torch.equal(again.maps["mu_measured"], known[0])


@pytest.mark.filterwarnings("error:.*attenuated counts")
def test_a_simulated_case_has_its_attenuation_beside_counts_that_want_it(tmp_path: Path):
    """The map of the case in 1/mm, with which its counts give the activity; without it the
    reconstruction warns, as it does of a uniform attenuation, and not of a scene without matter.
    """
    grid = ("grid.size=[20,16,16]", "grid.spacing=16", "grid.centre=[40,-40,0]")
    options = (*grid, "camera=dcspect80", "camera.pixels=8", "projector=spect")
    cases = {}
    for scene, more in {"cardiac": (), "derenzo": (), "uniform": ("projector.mu=0.0154",)}.items():
        known = scene.replace("uniform", "derenzo")
        settings = compose(f"scene={known}", *options, *more, config_name="simulate")
        (cases[scene],) = simulate(SimulateSettings(**settings), tmp_path / scene)
    case, path = cases["cardiac"], cases["cardiac"] / "mu.nii.gz"
    mu, voxels = read_volume(path)
    truth, _ = read_volume(case / "truth.nii.gz")
    sample = Acquired(RandomCardiac(), {"name": "spect"}).sample(0, 0, voxels, dcspect80(pixels=8))
    assert torch.equal(mu, sample.maps["mu"][0]) and 0.01 < mu.max() < 0.02
    assert not (cases["derenzo"] / "mu.nii.gz").exists()

    def total(scene: str, *more: str) -> float:
        seen = (f"views.path={cases[scene]}/views.h5", f"camera.path={tmp_path}/{scene}/rig.json")
        like = f"grid.like={cases[scene]}/truth.nii.gz"
        options = (*seen, like, "projector=spect", "method=osem", "method.iterations=2", *more)
        settings = compose(*options, config_name="reconstruct")
        out = tmp_path / f"{scene}{len(more)}"
        run_reconstruction(ReconstructSettings(**settings), out)
        return read_volume(out / "volume.nii.gz")[0].sum().item()

    total("derenzo")
    with pytest.warns(UserWarning, match="for attenuated counts, got no projector.mu"):
        total("uniform")
    assert total("cardiac", f"projector.mu={path}") == pytest.approx(truth.sum().item(), rel=0.3)
    with pytest.warns(UserWarning, match=f"projector=spect projector.mu={re.escape(str(path))} "):
        assert total("cardiac") < truth.sum().item() / 2


def test_attenuation_missing_from_the_cases_is_refused():
    """A projector with per-case attenuation refuses cases without attenuation, and direct calls."""
    batch, module = batch_of("dcspect_derenzo"), module_of("dcspect_cardiac", "osem")
    with pytest.raises(ValueError, match="as of the scene cardiac or nema"):
        module.operator(batch)
    with pytest.raises(TypeError, match="cases with their own attenuation"):
        module.projector(batch["volume"])
    with pytest.raises(TypeError, match="cases with their own attenuation"):
        module(batch["views"])
    for wrong in ({"of": "guessed"}, {"shift_mm": [1, 2]}):
        with pytest.raises(ValueError, match=r"projector\.mu of case or measured"):
            CaseAttenuation.of(wrong)
    with pytest.raises(TypeError, match=r"method\.assume: expected a mapping or null, got 0\.1"):
        check({"method": {"name": "sirt", "assume": 0.1}}, TrainSettings)
    with pytest.raises(TypeError, match="has no option 'muh'"):
        settings = TrainSettings(**settings_of("dcspect_cardiac"))
        build_module(settings, {"name": "sirt", "assume": {"muh": 0}}, 1.0)
    with pytest.raises(ValueError, match="a scene with matter"):
        SpectCt({"name": "derenzo"}, {"name": "circular"})
