"""`joint` of `mvrecon-reconstruct`: photopeaks, and gated frames, of one activity."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvrecon.apps.reconstruct import report, run_reconstruction
from mvrecon.apps.settings import ReconstructSettings, complete
from mvrecon.core.files.checks import Refused
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon.report.metrics import nrmse
from mvrecon_spect.operators.projector import Spect

GRID, RIG = Grid.centred(12, spacing=10.0), dcspect80(pixels=16, columns=[2, 7, 12, 17])
FINE = GRID.refined(2)
TIME, HOT = 6000.0, 40.0
#: Photons per decay, attenuation in 1/mm and intrinsic FWHM in mm: 113 and 208 keV of 177Lu.
PEAKS = ((0.062, 0.0163, 3.5), (0.104, 0.0136, 2.5))
PROJECTOR = ("projector=spect", "projector.diameter_mm=4", "projector.blur=true")
pytestmark = pytest.mark.usefixtures("blank_pictures", "parts")


def activity(shift: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Phantom:
    """Two hot ellipsoids in a warm one, in kBq/ml."""
    centres = torch.tensor([[0.0, 0, 0], [14, -8, 6], [-12, 10, -9]]) + torch.tensor(shift)
    sizes = torch.tensor([[36.0, 32, 34], [10, 11, 12], [9, 9, 9]])
    values, turns = torch.tensor([5.0, HOT, HOT]), torch.eye(3).expand(3, 3, 3)
    return Phantom((Solids("ellipsoid", centres, turns, sizes, values),))


def factors(branching: float) -> str:
    return f"factors: {{name: detector, time_s: {TIME}, branching: {branching}}}"


@pytest.fixture
def settings(tmp_path: Path, scan_of):
    """Settings of several files of counts, the first with options, others as in `joint`."""

    def of(first: torch.Tensor, others: list[torch.Tensor], joint: str, *options: str):
        for number, counts in enumerate(others):
            np.save(tmp_path / f"other{number}.npy", counts[0, 0].numpy())
        joint = joint.replace("DIR", str(tmp_path))
        common = (*PROJECTOR, "views.kind=counts", "method=osem", f"joint=[{joint}]")
        run = scan_of(first, RIG, GRID, *common, *options)
        return complete(ReconstructSettings(**run))

    return of


@pytest.fixture(scope="module")
def peaks() -> list[torch.Tensor]:
    """Poisson counts of both photopeaks, of voxels half as wide in every direction."""
    noise, counts = torch.Generator().manual_seed(0), []
    truth = voxelise(activity(), FINE)[None, None].float()
    for share, mu, width in PEAKS:
        A = Spect(FINE, RIG, 4.0, mu=mu, blur=True, intrinsic_mm=width)
        counts.append(torch.poisson(share * TIME * A(truth), generator=noise))
    return counts


def first(number: int) -> tuple[str, ...]:
    share, mu, width = PEAKS[number]
    options = f"projector.mu={mu}", f"projector.intrinsic_mm={width}", "method.iterations=30"
    return (*options, "method.subsets=4", f"+{factors(share).replace(': ', '=', 1)}")


SECOND = (
    f"{{views: {{path: DIR/other0.npy}}, projector: {{mu: {PEAKS[1][1]}, intrinsic_mm: "
    f"{PEAKS[1][2]}}}, factors: {{branching: {PEAKS[1][0]}}}}}"
)


def test_two_photopeaks_make_one_volume_in_kbq_per_ml(tmp_path, settings, peaks, capsys):
    """Each with its own attenuation, response and photons: the total activity is right within three
    standard deviations of its noise, 0.6 %, and the error, fitted to noise, less than that of each
    photopeak alone.
    """
    truth = voxelise(activity(), GRID)
    total = 1e-6 * truth.sum().item() * math.prod(GRID.spacing)
    table = run_reconstruction(settings(peaks[0], peaks[1:], SECOND, *first(0)), tmp_path / "both")
    assert table["unit"] == "kBq/ml" and table["views"]["count"] == 32
    assert table["total_mbq"] == pytest.approx(total, rel=0.02)
    report(table, tmp_path)
    errors = [nrmse(read_volume(tmp_path / "both" / "volume.nii.gz")[0], truth)]
    for number in (0, 1):
        alone = replace(settings(peaks[number], [], "", *first(number)), joint=None)
        run_reconstruction(alone, tmp_path / f"alone{number}")
        errors.append(nrmse(read_volume(tmp_path / f"alone{number}" / "volume.nii.gz")[0], truth))
    assert errors[0] < min(errors[1:])


def test_scatter_of_each_window_is_its_own(tmp_path, settings, peaks):
    """A flat scatter in the second window alone; without it the activity is too high."""
    level = torch.full_like(peaks[1], peaks[1].mean().item() / 2)
    noise = torch.Generator().manual_seed(1)
    other = peaks[1] + torch.poisson(level, generator=noise)
    np.save(tmp_path / "scatter.npy", level[0, 0].numpy())
    scatter = f"scatter: {{name: given, path: {tmp_path}/scatter.npy}}"
    tables = {}
    for name, joint in {"with": f"{SECOND[:-1]}, {scatter}}}", "without": SECOND}.items():
        run = settings(peaks[0], [other], joint, *first(0))
        tables[name] = run_reconstruction(run, tmp_path / name)["total_mbq"]
    total = 1e-6 * voxelise(activity(), GRID).sum().item() * math.prod(GRID.spacing)
    assert tables["with"] == pytest.approx(total, rel=0.02)
    assert tables["without"] > 1.1 * total


def test_gated_frames_are_shifted_back(tmp_path, settings, capsys):
    """Frames of closed-form ellipsoids that have moved, of unequal durations, on a finer grid: the
    shifts are right within four standard deviations, and the volume is that of the first frame.
    """
    shifts, times = ((0.0, 0, 0), (5.0, -3, 12), (0, 4, -7)), (TIME, 2 * TIME, TIME / 2)
    noise, frames = torch.Generator().manual_seed(0), []
    still = Spect(FINE, RIG, 4.0, blur=True)
    for shift, time in zip(shifts, times, strict=True):
        ideal = 0.9 * time * still(voxelise(activity(shift), FINE)[None, None].float())
        frames.append(torch.poisson(ideal, generator=noise))
    joint = ", ".join(
        f"{{views: {{path: DIR/other{n}.npy}}, factors: {{time_s: {time}}}}}"
        for n, time in enumerate(times[1:])
    )
    common = f"+{factors(0.9).replace(': ', '=', 1)}"
    errors = []
    for estimated in (False, True):
        options = common, f"estimate_shifts={estimated}"
        folder = tmp_path / f"run{estimated}"
        table = run_reconstruction(settings(frames[0], frames[1:], joint, *options), folder)
        errors.append(nrmse(read_volume(folder / "volume.nii.gz")[0], voxelise(activity(), GRID)))
    found, sigma = (torch.tensor(table["shifts"][name]) for name in ("shift_mm", "sigma_mm"))
    assert ((found - torch.tensor(shifts)).abs() < 4 * sigma + 0.05).all()
    assert sigma.max() < 1.0 and table["shifts"]["settled"]
    assert errors[1] < 0.8 * errors[0]
    report(table, tmp_path)


@pytest.mark.parametrize(
    ("joint", "options", "message"),
    [
        ("{projector: {mu: 0.01}}", first(0), "other views than those of another"),
        (SECOND, ("+scatter={name: given, path: x.npy}",), "its own scatter"),
        ("{views: {path: DIR/other0.npy}}", (), "expected factors.branching"),
        ("{views: {path: DIR/other0.npy}, factors: null}", first(0), "volumes of one unit"),
        (SECOND, (*first(0)[:2], "method=sirt"), "method of counts"),
        ("{views: {path: DIR/run/volume.nii.gz}}", (), "an input that the run does not write"),
        (SECOND, (*first(0), "calibrate=[offset_u]"), "without calibrate"),
        ("{views: {path: DIR/other0.npy, binning: 2}}", first(0), "views of one size"),
    ],
)
def test_what_no_likelihood_joins_is_refused(tmp_path, settings, peaks, joint, options, message):
    """Also tried: estimate_shifts without joint, a projector that has no such option."""
    with pytest.raises((Refused, ValueError), match=message):
        run_reconstruction(settings(peaks[0], peaks[1:], joint, *options), tmp_path / "run")
