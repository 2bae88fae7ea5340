"""Scatter of `mvrecon-reconstruct`, from files of a map and of other energy windows."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.apps.config import ReconstructSettings
from mvrecon.apps.reconstruct import reconstruct
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.projector import Spect

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
    reconstruct(settings(scatter), tmp_path / "run")
    volume, _ = read_volume(tmp_path / "run" / "volume.nii.gz")
    share = volume.sum().item() / (30000.0 * 64) - 1
    assert share > excess if excess else abs(share) < 0.03


def test_scatter_is_binned_like_the_views(tmp_path: Path, settings):
    run = settings("scatter={name: given, path: DIR/map.npy}", "views.binning=2")
    reconstruct(run, tmp_path / "run")
    volume, _ = read_volume(tmp_path / "run" / "volume.nii.gz")
    assert volume.sum().item() == pytest.approx(30000.0 * 64, rel=0.03)


@pytest.mark.parametrize(
    ("scatter", "options", "message"),
    [
        ("scatter={name: given, path: DIR/small.npy}", (), r"sizes \(16, 16, 16\) for scatter"),
        ("scatter={name: dew, lower: DIR/none.npy}", (), "no such file"),
        ("scatter={name: dew, lower: DIR/map.npy, k: -1}", (), "finite k of at least 0"),
        ("scatter={name: given, path: DIR/map.npy}", ("left_out=true",), "scatter without"),
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
        reconstruct(settings(scatter, *options), tmp_path / "run")
    assert not (tmp_path / "run").exists()
