"""Input that cannot be a SPECT measurement is refused by every reader and function, with a
message.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.apps.settings import SimulateSettings, TrainSettings
from mvrecon.apps.simulate import simulate
from mvrecon.core.options import check
from mvrecon.core.parts import REGISTRIES
from mvrecon.data.attenuation import attenuation
from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration.self_alignment import Aligned
from mvrecon_spect.files.interfile_views import InterfileViews
from mvrecon_spect.files.stir import StirScan, write_stir
from mvrecon_spect.files.stir_system import StirSystem
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring
from mvrecon_spect.methods.bsrem import bsrem
from mvrecon_spect.operators.projector import Spect

GRID = Grid.centred(8, spacing=15.0)
ELSEWHERE = Grid.centred(8, spacing=1.5, centre=(0, 0, 300))
RIG = dcspect80(pixels=6, columns=[2, 12])
#: Detectors between pinhole and object, right-handed all the same.
AVERTED = replace(RIG, origin=2 * RIG.source - RIG.origin, u=-RIG.u)
IN_CM = replace(RIG, **{name: getattr(RIG, name) / 10 for name in ("source", "origin", "u", "v")})

#: Of the projector: cameras, options, and what the message says.
PROJECTORS = {
    "pinhole in the object": (replace(RIG, source=RIG.source * 0.1), {}, "pinhole 0 in it"),
    "camera in cm": (IN_CM, {}, "mm and cm of camera and grid"),
    "detector before its pinhole": (AVERTED, {}, "detector's side of pinhole 0"),
    "skewed pixels": (replace(RIG, v=RIG.v + 0.3 * RIG.u), {}, "rectangular pixels, .* 73.3 deg"),
    "hole of 0 mm": (RIG, {"diameter_mm": 0.0}, "positive mm, got 0"),
    "hole as text": (RIG, {"diameter_mm": "2.3"}, "positive mm, got 2.3"),
    "hole without a size": (RIG, {"diameter_mm": None}, "positive mm, got None"),
    "hole in um": (RIG, {"diameter_mm": 2300.0}, "smaller than its way to the detector, 65"),
    "collimator in 1/cm": (RIG, {"collimator_mu": 36.04}, "is it in 1/cm"),
    "width without blur": (RIG, {"intrinsic_mm": 4.0}, "blur=True"),
    "mu negative": (RIG, {"mu": -0.01}, "zero or more"),
    "mu of water in 1/cm": (RIG, {"mu": 0.1536}, "is it in 1/cm"),
    "mu of NaN": (RIG, {"mu": float("nan")}, "finite attenuation"),
    "mu of another grid": (RIG, {"mu": torch.zeros(8, 8, 7)}, r"sizes \(8, 8, 8\)"),
}


@pytest.mark.parametrize("case", PROJECTORS)
def test_an_invalid_camera_hole_or_attenuation_is_refused(case: str):
    """Pinholes in the object or before their detector, and lengths and attenuation in another
    unit, are refused.
    """
    cameras, options, message = PROJECTORS[case]
    with pytest.raises(ValueError, match=message):
        Spect(GRID, cameras, **options)


@pytest.fixture(scope="module")
def operator() -> Spect:
    return Spect(GRID, RIG)


def counts(value: float = 1.0) -> torch.Tensor:
    return torch.full((1, 1, len(RIG), 6, 6), value)


#: Of the methods on counts: counts, options, and what the message says.
METHODS = {
    "counts negative": (counts(-1.0), {}, "finite and not negative, got"),
    "counts of NaN": (counts(torch.nan), {}, "finite and not negative, got"),
    "counts of fewer cameras": (counts()[:, :, 1:], {}, r"\(8, 6, 6\), got"),
    "background negative": (counts(), {"background": -0.1}, "background that are finite"),
    "background of other views": (counts(), {"background": torch.ones(7)}, "broadcast"),
    "no subset": (counts(), {"background": 1.0, "subsets": 0}, "1 to 8 subsets"),
    "more subsets than cameras": (counts(), {"background": 1.0, "subsets": 9}, "1 to 8 subsets"),
    "half a subset": (counts(), {"background": 1.0, "subsets": 2.5}, "got 2.5"),
    "iterations negative": (counts(), {"background": 1.0, "iterations": -1}, "at least 0, got -1"),
}


@pytest.mark.parametrize("method", [mv.osem, bsrem])
@pytest.mark.parametrize("case", METHODS)
def test_invalid_counts_background_and_subsets_are_refused(operator, method, case):
    """Reconstructions of counts refuse counts, background, subsets, iterations that cannot be."""
    measured, options, message = METHODS[case]
    with pytest.raises(ValueError, match=message):
        method(operator, measured, **options)


def test_subsets_need_not_divide_the_cameras(operator):
    measured = operator(torch.ones(1, 1, *GRID.shape))
    x = mv.osem(operator, measured, iterations=20, subsets=3)
    assert (operator(x) - measured).norm() < 0.02 * measured.norm()


def test_a_map_outside_the_grid_is_refused(tmp_path: Path):
    """An attenuation map with all of its matter outside the grid is refused."""
    path = tmp_path / "mu.nii.gz"
    save_volume(path, torch.full(ELSEWHERE.shape, 0.015), ELSEWHERE)
    with pytest.raises(ValueError, match=r"about \(0, 0, 0\) mm, .* got all of it elsewhere"):
        Spect(GRID, RIG, mu=path)


@pytest.mark.parametrize(
    ("value", "message"),
    [(0.04, "0.04 in half of what attenuates; is it in 1/cm"), (0.0015, "at most 0.0015")],
)
def test_lung_attenuation_in_1_per_cm_raises_a_warning(value: float, message: str):
    """Attenuation that could be in 1/mm, but is too much or too little for a body, is doubted."""
    mu = torch.zeros(GRID.shape)
    mu[2:6, 2:6, 2:6] = value
    with pytest.warns(UserWarning, match=message):
        Spect(GRID, RIG, mu=mu)


def test_water_bone_and_air_raise_no_warning(recwarn: pytest.WarningsRecorder):
    mu = torch.full(GRID.shape, 1e-5)
    mu[1:7, 1:7, 1:7], mu[3, 3] = 0.01536, 0.0295
    Spect(GRID, RIG, mu=mu)
    assert not recwarn.list


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["camera=circular", "projector=spect"], "extent 'behind', got 'segment'"),
        (["camera=dcspect80", "projector=spect", "projector.mu=0.15"], "is it in 1/cm"),
        (["camera=dcspect80", "projector=spect", "projector.mu=case"], "the scene cardiac or nema"),
        (["camera=dcspect80", "projector=spect", "projector.diameter_mm=a"], "positive mm, got a"),
    ],
)
def test_the_app_refuses_invalid_input_before_it_writes(
    tmp_path: Path, options: list, message: str
):
    """`mvrecon-simulate` refuses a rig or options that pinholes cannot have, in one sentence."""
    with pytest.raises((TypeError, ValueError), match=message) as refusal:
        settings = compose("scene=derenzo", *options, config_name="simulate")
        simulate(SimulateSettings(**settings), tmp_path / "run")
    assert not (tmp_path / "run").exists() and str(refusal.value).count("Expected") <= 1


@pytest.mark.parametrize("name", ["spect", "stir_pinhole"])
def test_a_misspelt_option_of_a_projector_is_refused_with_the_nearest_and_all(name: str):
    """In the words for those of the core, by the command and by the registry alike, which also has
    the options that only Python can give.
    """
    config = {"name": name, "blurr": True}
    words = f"'{name}'.* has no option 'blurr'; did you mean 'blur'.* Known: .*method"
    with pytest.raises(TypeError, match=rf"^projector \(the projector {words}"):
        check({"projector": config}, TrainSettings)
    with pytest.raises(TypeError, match=f"^The projector {words}.*support"):
        REGISTRIES["projector"].from_config(config, grid=GRID, cameras=RIG)


def test_an_option_that_footprints_have_not_is_refused():
    message = r"^The method 'footprints' has no option 'skip'\. Known: backend, support$"
    with pytest.raises(TypeError, match=message):
        Spect(GRID, RIG, blur=True, intrinsic_mm=40.0, skip="off")


@pytest.mark.parametrize("damage", ["cut short", "negative", "not finite"])
def test_invalid_interfile_counts_are_refused(tmp_path: Path, damage: str):
    """Interfile projections whose data are cut short, negative or not finite are refused."""
    hole = Opening(0, (0.0, 0.0, 0.0), "round", (1.0, 1.0))
    system = StirSystem(
        shape=(4, 4),
        pixel_mm=(2.0, 2.0),
        radius_mm=50.0,
        detector=DetectorText(0.4, 3.0, 0.44, (Ring(1, 0.0, 30.0),)),
        collimator=CollimatorText("pol", 28.0, 10.0, (hole,)),
    )
    write_stir(tmp_path, StirScan(system, torch.ones(1, 1, 1, 4, 4)))
    data = np.fromfile(tmp_path / "counts.s", "<f4")
    data[3] = {"cut short": 1, "negative": -1, "not finite": np.nan}[damage]
    data[: 15 if damage == "cut short" else 16].tofile(tmp_path / "counts.s")
    with pytest.raises(ValueError, match="cut short" if damage == "cut short" else "finite"):
        InterfileViews(tmp_path / "counts.hs").read(0, 1)


def test_attenuation_at_an_energy_without_a_table_is_refused():
    """Hounsfield units at an energy that no table has are refused, with those that have one."""
    with pytest.raises(ValueError, match=r"energies \[70.0, 140.5\] keV, got 511"):
        attenuation(torch.zeros(1), 511)


@pytest.mark.parametrize("name", ["osem", "mlem", "bsrem"])
def test_aligned_counts_are_none_of_them(name):
    """Alignment interpolates between pixels without making negative counts."""
    A, rng = Spect(GRID, RIG), torch.Generator().manual_seed(0)
    x = torch.zeros(1, 1, *GRID.shape)
    x[..., 3:6, 2:5, 4:6] = 1.0
    mean = A(x)
    counts = torch.poisson(5 * mean / mean[mean > 0].mean(), generator=rng)
    out = Aligned({"name": name, "iterations": 2})(counts, A)
    assert out.volume.isfinite().all() and out.volume.max() > 0
    assert out.alignment is not None and (out.alignment.gain > 0).float().mean() > 0.9
