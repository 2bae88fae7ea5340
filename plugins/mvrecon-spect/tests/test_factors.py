"""Factors and units of `mvrecon-reconstruct`: counts of a known activity give it back."""

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.apps.progress import logger
from mvrecon.apps.reconstruct import read_scan, report, run_reconstruction
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.operators.projector import Spect

GRID, RIG = Grid.centred(10, spacing=14.0), dcspect80(pixels=16, columns=[2, 7, 12, 17])
#: Activity of a cube in kBq/ml and in MBq, seconds of a view, photons of a decay.
LEVEL, TOTAL, TIME, BRANCHING = 50.0, 50e-6 * 64 * 14**3, 40.0, 0.89
pytestmark = pytest.mark.usefixtures("blank_pictures", "parts")


@pytest.fixture
def settings(tmp_path: Path, scan_of):
    """Settings for the expected counts of the cube with factors [m] or [m v u]."""
    x = torch.zeros(1, 1, *GRID.shape)
    x[..., 3:7, 3:7, 3:7] = LEVEL
    ideal = Spect(GRID, RIG)(x) * (TIME * BRANCHING)

    def of(by: torch.Tensor, factors: str, *options: str) -> ReconstructSettings:
        counts = ideal * by.reshape(*by.shape, *(1,) * (3 - by.ndim))
        text = factors.replace("DIR", str(tmp_path)), "projector=spect", "views.kind=counts"
        return ReconstructSettings(**scan_of(counts, RIG, GRID, "method=osem", *text, *options))

    of.ideal = ideal
    return of


def level(folder: Path) -> float:
    """Mean of the cube and its blurred edge, as of the cube."""
    return read_volume(folder / "volume.nii.gz")[0].sum().item() / 64


def test_the_activity_is_that_of_the_source_in_kbq_per_ml(tmp_path, settings, capsys, caplog):
    """By the time and the branching ratio; the total is in MBq."""
    caplog.set_level(logging.INFO, logger.name)
    factors = f"factors={{name: detector, time_s: {TIME}, branching: {BRANCHING}}}"
    table = run_reconstruction(settings(torch.ones(16), factors), tmp_path / "run")
    assert table["unit"] == "kBq/ml" and table["total_mbq"] == pytest.approx(TOTAL, rel=0.01)
    assert level(tmp_path / "run") == pytest.approx(LEVEL, rel=0.01)
    report(table, tmp_path)
    assert f"{table['total_mbq']:.4g} MBq in the grid" in capsys.readouterr().out
    relative = run_reconstruction(settings(torch.ones(16), "factors=null"), tmp_path / "rel")
    assert relative["unit"] == "activity" and "total_mbq" not in relative
    assert level(tmp_path / "rel") == pytest.approx(LEVEL * TIME * BRANCHING, rel=0.01)
    report(relative, tmp_path)
    assert "activity (relative;" in capsys.readouterr().out


def test_the_sensitivity_is_that_of_the_law(tmp_path, settings):
    """Sum over pinholes of d^2 cos^3 / (16 h^2) at the centre, in counts per s and MBq."""
    table = run_reconstruction(settings(torch.ones(16), "factors=null"), tmp_path / "run")
    normal = torch.linalg.cross(RIG.u, RIG.v)
    normal = normal / normal.norm(dim=1, keepdim=True)
    h = (RIG.source * normal).sum(dim=1).abs()
    law = (2.3**2 * (h / RIG.source.norm(dim=1)) ** 3 / (16 * h**2)).sum().item()
    assert table["sensitivity_cps_per_mbq"] == pytest.approx(1e6 * law, rel=0.01)


@pytest.mark.parametrize("every", [1, 2])
def test_decay_between_and_within_views_is_undone(tmp_path, settings, every):
    """Counts are integrals of exp(-k t) over each view, here of a half-life of four views; the
    activity is that at the reference time, a minute before the first view.
    """
    rate, starts = math.log(2) / (4 * TIME), TIME * torch.arange(16).double()
    ends = starts + TIME
    decay = ((-rate * starts).exp() - (-rate * ends).exp()) / (rate * TIME) * math.exp(-60 * rate)
    lines = "\n".join(map(str, starts.tolist()))
    (tmp_path / "starts.txt").write_text(f"# s\n{lines}\n", encoding="utf-8-sig")  # by Notepad
    factors = (
        f"factors={{name: detector, half_life_s: {4 * TIME}, start_s: DIR/starts.txt, "
        f"reference_s: -60, time_s: {TIME}, branching: {BRANCHING}}}"
    )
    run_reconstruction(settings(decay, factors, f"views.every={every}"), tmp_path / "run")
    assert level(tmp_path / "run") == pytest.approx(LEVEL, rel=0.01)


@pytest.mark.parametrize("paralysable", [False, True])
@pytest.mark.parametrize("rows", ["null", "[4,12]"])
def test_dead_time_is_undone(tmp_path, settings, paralysable, rows):
    """Registered rates m = n / (1 + n tau), or n exp(-n tau), of n events of which 0.8 are in the
    window; also of a part of the detector, whose rate is that of the whole.
    """
    n = settings.ideal.double().sum(dim=(0, 1, 3, 4)) / (TIME * 0.8)
    tau = 0.3 / n.max().item()
    live = (-n * tau).exp() if paralysable else 1 / (1 + n * tau)
    factors = (
        f"factors={{name: detector, dead_time_us: {1e6 * tau}, paralysable: {paralysable}, "
        f"in_window: 0.8, time_s: {TIME}, branching: {BRANCHING}}}"
    )
    run = settings(live, factors, f"views.rows={rows}")
    scan = read_scan(run)
    expected = (live * TIME * BRANCHING)[:, None, None].expand_as(scan.factors)
    torch.testing.assert_close(scan.factors, expected, rtol=1e-5, atol=0)
    if rows == "null":
        run_reconstruction(run, tmp_path / "run")
        assert level(tmp_path / "run") == pytest.approx(LEVEL, rel=0.01)


def test_no_dead_time_changes_nothing_whatever_it_would_need(tmp_path, settings):
    """As in a sweep of dead times that begins at 0."""
    factors = "factors={name: detector, dead_time_us: 0, in_window: 0.8, paralysable: true}"
    assert (read_scan(settings(torch.ones(16), factors)).factors == 1).all()


@pytest.mark.parametrize("binning", [1, 2])
def test_a_flood_with_a_gradient_is_undone(tmp_path, settings, binning):
    """A sensitivity from 0.5 to 1.5 across the detector, and a dead pixel with counts of noise."""
    slope = torch.linspace(0.5, 1.5, 16).expand(16, 16, 16).clone()
    flood = 1e4 * slope
    flood[3, 8:10, 8:10] = 0
    np.save(tmp_path / "flood.npy", flood.numpy())
    run = settings(slope, "factors={name: detector, flood: DIR/flood.npy}")
    run.views["binning"] = binning
    with pytest.warns(UserWarning, match="dead in the flood"):
        run_reconstruction(run, tmp_path / "run")
    assert level(tmp_path / "run") == pytest.approx(LEVEL * TIME * BRANCHING, rel=0.02)


@pytest.mark.parametrize(
    ("factors", "options", "message"),
    [
        ("half_life_s: 100, time_s: 1", (), "expected factors.start_s"),
        ("half_life_s: 100, time_s: 1, start_s: [0, 1]", (), "16 finite numbers"),
        ("half_life_s: 100, start_s: 0", (), "expected factors.time_s"),
        ("branching: 0.89", (), "expected factors.time_s"),
        ("dead_time_us: 1, time_s: 1", (), "expected factors.in_window"),
        ("reference_s: -60, time_s: 1", (), "expected factors.half_life_s with reference_s=-60"),
        ("start_s: [1, 2], time_s: 1", (), "expected factors.half_life_s with start_s"),
        ("smoothing_mm: 4", (), "expected factors.flood"),
        ("in_window: 0.5", (), "expected factors.dead_time_us"),
        ("paralysable: true", (), "expected factors.dead_time_us"),
        ("branching: 89, time_s: 1", (), "in per cent"),
        ("half_life_s: 6.007, start_s: 0, time_s: 1200", (), "is it in hours"),
        ("time_s: 1", ("calibrate=[gains]",), "factors without calibrate"),
        ("time_s: 1", ("projector=drr", "views.kind=integrals"), "projector of emission"),
    ],
)
def test_missing_times_are_asked_for(tmp_path, settings, factors, options, message):
    run = settings(torch.ones(16), f"factors={{name: detector, {factors}}}", *options)
    with pytest.raises((Refused, ValueError), match=message):
        run_reconstruction(run, tmp_path / "run")
