"""Scatter of `mvrecon-reconstruct`, from files of a map and of other energy windows."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import mvrecon as mv
from mvrecon.apps.config import compose
from mvrecon.apps.reconstruct import read_scan, run_reconstruction
from mvrecon.apps.scan import Scan
from mvrecon.apps.settings import ReconstructSettings, SimulateSettings
from mvrecon.apps.simulate import simulate
from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.report.viz import review
from mvrecon_spect.operators.projector import Spect

GRID, RIG = Grid.centred(10, spacing=14.0), dcspect80(pixels=16, columns=[2, 7, 12, 17])
pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture
def settings(tmp_path: Path, scan_of, parts):
    """Of a block's counts with a third of scatter, beside a map and two windows of that."""
    x, rng = torch.zeros(1, 1, *GRID.shape), torch.Generator().manual_seed(0)
    x[..., 3:7, 3:7, 3:7] = 30000.0
    primary = Spect(GRID, RIG)(x)
    scatter = (primary.mean() / 2).expand_as(primary)
    np.save(tmp_path / "map.npy", scatter[0, 0].numpy())
    for name, share in (("lower", 2.0), ("upper", 0.5)):
        counts = torch.poisson(share * scatter, rng)[0, 0]
        np.save(tmp_path / f"{name}.npy", counts.numpy().astype("u2"))
    np.save(tmp_path / "small.npy", scatter[0, 0, :, 1:].numpy())
    counts = torch.poisson(primary + scatter, rng)

    def of(scatter: str, *options: str) -> ReconstructSettings:
        texts = scatter.replace("DIR", str(tmp_path)), "projector=spect", "views.kind=counts"
        return ReconstructSettings(**scan_of(counts, RIG, GRID, "method=osem", *texts, *options))

    return of


@pytest.mark.parametrize(
    ("scatter", "excess"),
    [
        ("scatter=null", 0.3),
        ("scatter={name: given, path: DIR/map.npy}", 0.0),
        ("scatter={name: given, path: DIR/lower.npy, fraction: 0.3333}", 0.0),
        ("scatter={name: dew, lower: DIR/lower.npy, smoothing_mm: 20}", 0.0),
        # (2 s / 4 + 0.5 s / 5) w / 2 = s
        (
            "scatter={name: tew, lower: DIR/lower.npy, upper: DIR/upper.npy, "
            "widths_kev: [4, 3.3333, 5], smoothing_mm: 20}",
            0.0,
        ),
    ],
)
def test_scatter_from_files_recovers_the_activity(tmp_path: Path, settings, scatter, excess):
    """Without it the scattered counts are activity."""
    run_reconstruction(settings(scatter), tmp_path / "run")
    volume, _ = read_volume(tmp_path / "run" / "volume.nii.gz")
    share = volume.sum().item() / (30000.0 * 64) - 1
    assert share > excess if excess else abs(share) < 0.03


SIMULATED = (
    *("scene=derenzo", "scene.radius_mm=40", "scene.height_mm=70", "scene.fill=null"),
    *("grid.size=[10,10,10]", "grid.spacing=12", "camera=dcspect80", "camera.pixels=12"),
    *("projector=spect", "acquisition=counts", "acquisition.closed_form=false", "picture=mosaic"),
)
#: A scan of 650 000 counts with 0.3 of scatter to the primaries, and a window below the photopeak
#: with twice its counts: in the same time, in a tenth, and in ten times the time.
SCANS = {
    "peak": ("counts=650000", "scatter=0.3", "scatter_mm=60"),
    "below": ("counts=300000", "blur_mm=60"),
    "short": ("counts=30000", "blur_mm=60", "duration_s=0.1"),
    "long": ("counts=3000000", "blur_mm=60", "duration_s=10"),
}


@pytest.fixture(scope="module")
def scans(tmp_path_factory) -> dict[str, Path]:
    """The views of simulated scans."""
    folder = tmp_path_factory.mktemp("scans")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(review, "mosaic", lambda *args: np.zeros((2, 2, 3), "u1"))
        for name, options in SCANS.items():
            more = (f"acquisition.{option}" for option in options)
            options = compose(*SIMULATED, *more, config_name="simulate")
            simulate(SimulateSettings(**options), folder / name)
    return {name: next((folder / name).glob("cases/*/views.h5")) for name in SCANS}


def scan_with(scans: dict[str, Path], scatter: str, main: str = "peak", *options: str) -> Scan:
    for name, path in scans.items():
        scatter = scatter.replace(f"{name}.h5", str(path))
    settings = compose(
        f"views.path={scans[main]}",
        "camera=from_file",
        f"camera.path={scans['peak'].parents[2]}/rig.json",
        *("grid.size=[10,10,10]", "grid.spacing=12", "projector=spect", "method=osem"),
        f"scatter={scatter}",
        *options,
        config_name="reconstruct",
    )
    return read_scan(ReconstructSettings(**settings))


@pytest.mark.parametrize("name", SCANS)
def test_a_file_of_counts_is_in_counts(scans, name):
    """Poisson numbers whose sum is that of the acquisition; divided by the dose, they are the
    views of the activity, whatever their time.
    """
    total = float(SCANS[name][0].removeprefix("counts="))
    with h5py.File(scans[name]) as file:
        counts, about = file["views"][:].astype("f8"), dict(file["views"].attrs)
    assert np.array_equal(counts, counts.round())
    assert counts.sum() == pytest.approx(total, abs=5 * total**0.5)
    assert about["unit"] == "counts" and about["unit_per_dose"] == "spect of activity"
    assert about["duration"] == {"short": 0.1, "long": 10.0}.get(name, 1.0)
    scan = scan_with(scans, "null", name)
    views = scan.measured.whole().views.double()
    np.testing.assert_allclose(views * about["dose"], counts, rtol=1e-6)
    assert scan.dose == about["dose"] and scan.unit == "activity" and scan.counts


def test_counts_of_a_known_dose_are_absolute_by_their_time(scans, parts):
    """The unit of the scene is then no longer used: x is in decays per s and mm^3."""
    factors = "factors={name: detector, branching: 0.5}"
    scan, relative = (scan_with(scans, "null", "long", *o) for o in ((factors,), ()))
    assert scan.unit == "kBq/ml" and scan.dose == 1 and (scan.factors == 0.5 * 10).all()
    counts = relative.dose * relative.measured.whole().views
    torch.testing.assert_close(scan.measured.whole().views, counts)


@pytest.mark.pairwise(
    scatter=[
        ("{name: dew, lower: WINDOW.h5, smoothing_mm: 40}", 150_000),
        ("{name: dew, lower: WINDOW.h5, k: 0.25, smoothing_mm: 40}", 75_000),
        ("{name: tew, lower: WINDOW.h5, widths_kev: [28, 28, 28]}", 150_000),
        ("{name: tew, lower: WINDOW.h5, upper: WINDOW.h5, widths_kev: [28, 14, 28]}", 150_000),
        ("{name: given, path: WINDOW.h5}", 300_000),
        ("{name: given, path: WINDOW.h5, fraction: 0.25}", 162_500),
    ],
    window=["below", "short", "long"],
)
def test_scatter_from_a_simulated_window_is_in_counts(scans, scatter, window):
    """The true scatter is 150 000 counts; it was 1.67 times as many by the ratio of the doses. Of
    windows of another duration the counts are scaled to the scan's.

    Tried beside these: binned views, whose sums are the same.
    """
    text, expected = scatter
    for binning in (1, 2):
        options = f"views.binning={binning}"
        scan = scan_with(scans, text.replace("WINDOW", window), "peak", options)
        made = scan.scatter.double().sum().item() * scan.dose
        assert made == pytest.approx(expected, rel=0.03)


def test_without_scatter_the_activity_has_its_scale(scans):
    """The sum of the volume is the truth's to 10 % with DEW, and 0.2 higher without it."""
    truth, _ = read_volume(scans["peak"].with_name("truth.nii.gz"))
    shares = []
    for scatter in ("null", "{name: dew, lower: below.h5, smoothing_mm: 40}"):
        scan = scan_with(scans, scatter)
        A, views = scan.posed("cpu")
        volume = mv.osem(A, views, 4, background=scan.scatter)
        shares.append(volume.sum().item() / truth.sum().item())
    assert shares[1] == pytest.approx(1.0, abs=0.1) and shares[0] > shares[1] + 0.15


@pytest.mark.parametrize("unit", ["spect of activity", "counts"])
def test_windows_of_an_unknown_dose_are_refused(scans, tmp_path, unit):
    """Views of an older version, of an acquisition without counts, and counts without a dose, as
    window and as scan; only a map that is scaled to a fraction may have any unit.
    """
    old = tmp_path / "old.h5"
    with h5py.File(scans["below"]) as file, h5py.File(old, "w") as made:
        dose = file["views"].attrs["dose"]
        made["views"] = (file["views"][:] / dose).astype("f4")
        made["views"].attrs.update(axes="camera, v, u", unit=unit)
    known = {**scans, "old": old}
    message = "unknown dose" if unit != "counts" else "counts with a positive dose, got None"
    for scatter in (
        "{name: dew, lower: old.h5}",
        "{name: tew, lower: below.h5, upper: old.h5, widths_kev: [28, 28, 28]}",
        "{name: given, path: old.h5}",
    ):
        with pytest.raises(Refused, match=message):
            scan_with(known, scatter)
    with pytest.raises(Refused, match=message):
        scan_with(known, "{name: dew, lower: below.h5}", "old")
    if unit != "counts":
        made = scan_with(known, "{name: given, path: old.h5, fraction: 0.25}")
        assert made.scatter.sum().item() * made.dose == pytest.approx(162_500, rel=0.01)
        assert scan_with(known, "null", "old").unit == "activity"  # still readable


def test_windows_beside_bad_pixels_have_whole_counts(tmp_path: Path, settings, recwarn):
    """The bad ones, which are filled from their neighbours, are left out, not told as scaled."""
    bad = np.zeros((16, 16), bool)
    bad[5, 6] = bad[8, 8] = True
    np.save(tmp_path / "bad.npy", bad)
    window = "scatter={name: dew, lower: DIR/lower.npy}"
    read_scan(settings(window, f"views.bad_pixels={tmp_path}/bad.npy"))
    assert not [w for w in recwarn if "whole numbers" in str(w.message)]


def test_scatter_is_binned_like_the_views(tmp_path: Path, settings):
    run = settings("scatter={name: given, path: DIR/map.npy}", "views.binning=2")
    run_reconstruction(run, tmp_path / "run")
    volume, _ = read_volume(tmp_path / "run" / "volume.nii.gz")
    assert volume.sum().item() == pytest.approx(30000.0 * 64, rel=0.03)


@pytest.mark.parametrize(
    ("scatter", "options", "message"),
    [
        ("scatter={name: given, path: DIR/small.npy}", (), r"sizes \(16, 16, 16\)"),
        ("scatter={name: dew, lower: DIR/none.npy}", (), "no such file"),
        ("scatter={name: dew, lower: DIR/map.npy, k: -1}", (), "finite k of at least 0"),
        ("scatter={name: given, path: DIR/map.npy}", ("left_out=true",), "scatter without"),
        ("scatter={name: given, path: DIR/map.npy}", ("correct=align",), "scatter without"),
        ("scatter={name: given, path: DIR/map.npy}", ("method=sirt",), "a method with a backgr"),
        (
            "scatter={name: given, path: DIR/map.npy}",
            ("projector=drr", "views.kind=integrals"),
            "expected counts and a projector of emission",
        ),
    ],
)
def test_inconsistent_scatter_is_refused(tmp_path: Path, settings, scatter, options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run_reconstruction(settings(scatter, *options), tmp_path / "run")
    assert not (tmp_path / "run").exists()
