"""DICOM NM as measured views: one window and frame in time, by the rig of a camera file."""

import math
from copy import deepcopy
from pathlib import Path

import pytest
import torch

from mvrecon.apps.config import compose
from mvrecon.apps.reconstruct import read_scan
from mvrecon.apps.scan import Scan
from mvrecon.apps.settings import ReconstructSettings, complete
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon_spect.files.nm import read_nm
from tests.data.nm_files import in_time, study

pydicom = pytest.importorskip("pydicom")
pytestmark = pytest.mark.usefixtures("parts")
#: Angles of the study's views, in its order: two heads that turn clockwise.
ANGLES = (10.0, 340.0, 310.0, 190.0, 160.0, 130.0)


def rig(*degrees: float) -> Cameras:
    """Pinholes 10 mm from the axis, and detectors of 4 x 5 pixels 40 mm behind them, at angles from
    the patient's back (-y) to the left (-x)."""
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    out = torch.stack([-angle.sin(), -angle.cos(), 0 * angle], dim=1)
    down = torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64).expand_as(out)
    right = 1.5 * torch.linalg.cross(out, down / 2)
    origin = 50 * out - 1.5 * down - 2 * right
    return Cameras(10 * out, origin, right, down, (4, 5), extent="behind")


def scan(path: Path, cameras: Cameras, *options: str) -> Scan:
    files.save(cameras, path.with_name("rig.json"))
    grid = "grid.size=[4,4,4]", "grid.spacing=2", "projector=spect", "method=osem"
    camera = "camera=from_file", f"camera.path={path.with_name('rig.json')}"
    settings = compose(f"views.path={path}", *camera, *grid, *options, config_name="reconstruct")
    return read_scan(complete(ReconstructSettings(**settings)))


@pytest.mark.parametrize("name", ["a.dcm", "IM0001"])
def test_a_tomogram_is_read_in_the_order_of_its_vectors(tmp_path: Path, name: str):
    path = study(tmp_path / name)
    expected = read_nm(path)
    measured = scan(path, rig(*ANGLES), "views.dataset=window2")
    assert torch.equal(measured.measured.whole().views, expected.counts[1][0, 0])
    assert (measured.counts, measured.dose, measured.unit) == (True, 1.0, "activity")
    assert measured.measured.stack.duration_s == 20.0


def test_windows_and_frames_are_chosen_by_number_or_listed(tmp_path: Path):
    path = study(tmp_path / "a.dcm")
    both = r"window1 \(scatter, 110 to 126 keV\), window2 \(peak, 126.5 to 154.5 keV\)"
    for wrong in (None, "window3", "window1/window2", "peak"):
        with pytest.raises(Refused, match=both):
            open_projections(path, dataset=wrong)
    assert open_projections(f"{path}:/window1").read(0, 1)[0, 2, 2] == 1101
    gated = in_time(tmp_path / "g.dcm", ("RRIntervalVector", "TimeSlotVector"))
    with pytest.raises(Refused, match="frame1, .*frame6"):
        open_projections(gated)
    assert open_projections(gated, dataset="frame3").read(0, 2)[:, 1, 1].tolist() == [113, 213]


def test_starts_are_those_of_the_file(tmp_path: Path):
    """Two heads measure three views one after the other; a dynamic frame has its own start, and of
    a gated one the duration is unknown.
    """
    stack = open_projections(study(tmp_path / "a.dcm"), dataset="window1")
    assert stack.starts_s == [0.0, 20.0, 40.0] * 2
    gated = open_projections(
        in_time(tmp_path / "g.dcm", ("RRIntervalVector", "TimeSlotVector")), dataset="frame2"
    )
    assert gated.duration_s is gated.starts_s is None
    settings = scan(
        tmp_path / "a.dcm",
        rig(*ANGLES),
        "views.dataset=window2",
        "factors={name: detector, half_life_s: 20, branching: 0.5}",
    )
    share = 0.5 / math.log(2) * torch.tensor([1, 0.5, 0.25] * 2).double()
    torch.testing.assert_close(settings.factors[:, 2, 2], 20 * 0.5 * share)
    assert settings.unit == "kBq/ml"


def test_views_of_different_durations_are_refused(tmp_path: Path):
    """Twice the counts in twice the time would be twice the activity."""
    file = pydicom.dcmread(study(tmp_path / "a.dcm"))
    file.RotationVector = file.DetectorVector
    (turn,) = file.RotationInformationSequence
    del turn.StartAngle
    longer = deepcopy(turn)
    longer.ActualFrameDuration = 40000
    file.RotationInformationSequence = [turn, longer]
    file.save_as(tmp_path / "b.dcm")
    with pytest.raises(Refused, match="one duration, got 20 to 40 s"):
        open_projections(tmp_path / "b.dcm", dataset="window2")


def test_scatter_is_estimated_from_another_window_of_the_file(tmp_path: Path):
    path = study(tmp_path / "a.dcm")
    dew = f"scatter={{name: dew, lower: '{path}:/window1', k: 0.25}}"
    found = scan(path, rig(*ANGLES), "views.dataset=window2", dew).scatter
    assert torch.equal(found, 0.25 * read_nm(path).counts[0])


def test_the_angles_of_the_rig_are_those_of_the_file_but_for_a_turn(tmp_path: Path):
    """A rig in another order, or about the opposite axis, is refused; one turned about z is not."""
    path, chosen = study(tmp_path / "a.dcm"), "views.dataset=window2"
    scan(path, rig(*(angle + 77.3 for angle in ANGLES)), chosen)
    for wrong in (ANGLES[::-1], [-angle for angle in ANGLES], (*ANGLES[:5], 133.0)):
        with pytest.raises(Refused, match="expected cameras in the file's order of detectors"):
            scan(path, rig(*wrong), chosen)
    with pytest.raises(ValueError, match="expected one camera for each of 6 views"):
        scan(path, rig(*ANGLES[:5]), chosen)


def test_two_windows_of_a_file_are_joined_with_their_photons(tmp_path: Path):
    """Frames of a gated file likewise, whose duration is given."""
    path, window = study(tmp_path / "a.dcm"), "views.dataset=window2"
    first = "factors={name: detector, branching: 0.5}"
    joint = "joint=[{views: {dataset: window1}, factors: {branching: 0.1}}]"
    found, counts = scan(path, rig(*ANGLES), window, first, joint), read_nm(path).counts
    assert torch.equal(found.measured.whole().views, torch.cat([counts[1], counts[0]], dim=2)[0, 0])
    assert found.factors[:, 2, 2].tolist() == [10.0] * 6 + [2.0] * 6
    gated = in_time(tmp_path / "g.dcm", ("RRIntervalVector", "TimeSlotVector"))
    first = "factors={name: detector, branching: 0.5, time_s: 4}"
    frames = "joint=[{views: {dataset: frame3}, factors: {time_s: 2}}]"
    found = scan(gated, rig(10.0, 190.0), "views.dataset=frame2", first, frames)
    assert found.factors[:, 2, 2].tolist() == [2.0] * 2 + [1.0] * 2
