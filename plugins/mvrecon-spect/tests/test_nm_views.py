"""DICOM NM as measured views: one window and frame in time, by the rig of a camera file."""

import math
import warnings
from copy import deepcopy
from pathlib import Path

import numpy as np
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
from mvrecon.geometry.cameras.formats.common import from_world
from mvrecon_spect.files.interfile_views import InterfileViews
from mvrecon_spect.files.nm import read_frames, read_nm
from tests.data.nm_files import in_time, item, study

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


def in_phases(path: Path, *seconds: int, **changes: object) -> Path:
    """Four frames of a phase and two of a second one, of these durations."""
    phases = [
        item(
            pydicom.Dataset,
            PhaseDelay=0,
            ActualFrameDuration=1000 * duration,
            PauseBetweenFrames=0,
            NumberOfFramesInPhase=count,
        )
        for duration, count in zip(seconds, (4, 2), strict=True)
    ]
    vectors = ("PhaseVector", "TimeSliceVector")
    return in_time(path, vectors, PhaseInformationSequence=phases, **changes)


@pytest.mark.parametrize("image", [None, 10000, 60000])
def test_each_frame_of_a_dynamic_study_has_the_duration_of_its_phase(tmp_path: Path, image):
    """Whatever the image or, without it, a rotation states. Also tried: three phases, the counts of
    a window in frames of unequal durations as scatter.
    """
    given = {"ActualFrameDuration": image, "RotationInformationSequence": []} if image else {}
    path = in_phases(tmp_path / "a.dcm", 10, 60, **given)
    for name, duration, start in (("frame2", 10.0, 10.0), ("frame6", 60.0, 100.0)):
        stack = open_projections(path, dataset=name)
        assert stack.duration_s == duration and stack.starts_s == [start] * 2
    assert [one.views[0].duration_s for _, one in read_frames(path)] == [10.0] * 4 + [60.0] * 2


def test_a_rotation_of_another_duration_than_its_phase_is_refused(tmp_path: Path):
    """Of several views in each frame: the duration of a view may be either."""
    phases = pydicom.dcmread(in_phases(tmp_path / "a.dcm", 10, 60)).PhaseInformationSequence
    slices = [1, 1, 2, 2, 3, 3, 4, 4, 1, 1, 2, 2]
    times = {"PhaseVector": [1] * 8 + [2] * 4, "TimeSliceVector": slices}
    views = {"DetectorVector": [1] * 12, "AngularViewVector": [1, 2] * 6}
    given = {"EnergyWindowVector": [1] * 12, "PhaseInformationSequence": phases, **times, **views}
    with pytest.raises(Refused, match="of RotationInformationSequence in PhaseInf.*20000.*10000"):
        open_projections(study(tmp_path / "b.dcm", **given), dataset="frame1")
    phases[0].ActualFrameDuration = 20000
    stack = open_projections(study(tmp_path / "c.dcm", **given), dataset="frame6")
    assert stack.duration_s == 60.0 and stack.starts_s is None  # one view after the other?


def test_the_duration_of_a_gate_is_not_that_of_its_views(tmp_path: Path):
    """Also of a single gate, such as one that was exported alone: neither 20 s of a view nor the
    0.125 s of a slot. Also tried: without FrameTime, several R-R intervals.
    """
    slot = item(pydicom.Dataset, FrameTime=125.0)
    gate = [item(pydicom.Dataset, DataInformationSequence=[slot])]
    for turn in ({}, {"RotationInformationSequence": []}):
        path = study(tmp_path / "a.dcm", GatedInformationSequence=gate, **turn)
        stack = open_projections(path, dataset="window1")
        assert stack.duration_s is stack.starts_s is None


def test_an_unknown_start_of_a_frame_is_asked_for(tmp_path: Path):
    """Frames in time without phases have a duration by their rotation, and no start; a duration
    of 0 is unknown.
    """
    path = in_time(tmp_path / "a.dcm", ("PhaseVector", "TimeSliceVector"))
    stack = open_projections(path, dataset="frame3")
    assert stack.duration_s == 20.0 and stack.starts_s is None
    turn = item(pydicom.Dataset, ActualFrameDuration=0)
    path = study(tmp_path / "b.dcm", RotationInformationSequence=[turn])
    assert open_projections(path, dataset="window1").duration_s is None
    turn.ActualFrameDuration = -1
    with pytest.raises(Refused, match="ActualFrameDuration is not negative"):
        open_projections(study(tmp_path / "c.dcm", RotationInformationSequence=[turn]))


def test_what_a_phase_does_not_state_is_unknown_or_none(tmp_path: Path):
    """A duration of 0 ms as well as an absent one: its own frames and the starts of later ones are
    unknown, those before are not. Where no phase states one, the rotation does; a pause or delay
    that is absent is none, and a number of frames that of the vectors. Also tried: the first phase
    of 0 ms, empty values, a file of one frame in time.
    """
    path = in_phases(tmp_path / "a.dcm", 10, 0)
    for name, duration, starts in (("frame4", 10.0, [30.0] * 2), ("frame6", None, None)):
        stack = open_projections(path, dataset=name)
        assert stack.duration_s == duration and stack.starts_s == starts
    with pytest.raises(
        Refused, match=r"frame4 \(from 30 s for 10 s\), frame5 \(from 40 s\), frame6"
    ):
        open_projections(path)
    frames, studies = zip(*read_frames(in_phases(tmp_path / "b.dcm", 0, 0)), strict=True)
    assert [frame[4:] for frame in frames] == [(0.0, None)] + [(None, None)] * 5
    assert {view.duration_s for one in studies for view in one.views} == {20.0}
    bare = [item(pydicom.Dataset, ActualFrameDuration=1000 * duration) for duration in (10, 60)]
    times = ("PhaseVector", "TimeSliceVector")
    path = in_time(tmp_path / "c.dcm", times, PhaseInformationSequence=bare)
    assert [frame.start_s for frame, _ in read_frames(path)] == [0, 10, 20, 30, 40, 100]
    late = in_time(tmp_path / "e.dcm", times, PhaseInformationSequence=bare[:1] * 2 + bare[1:])
    dataset = pydicom.dcmread(late)
    dataset.PhaseVector = [{1: 1, 2: 3}[number] for number in dataset.PhaseVector]
    dataset.save_as(late)  # without frames of phase 2, of which no number is stated
    assert [frame.start_s for frame, _ in read_frames(late)] == [0, 10, 20, 30, None, None]
    still = [item(pydicom.Dataset, ActualFrameDuration=0, NumberOfFramesInPhase=1)]
    stack = open_projections(
        study(tmp_path / "d.dcm", PhaseInformationSequence=still), dataset="window1"
    )
    assert stack.duration_s == 20.0 and stack.starts_s == [0.0, 20.0, 40.0] * 2


def test_counts_without_their_photons_are_not_joined(tmp_path: Path):
    """Two windows, and two frames of unequal durations, of a file without a dose. Also tried:
    factors without branching in the second one alone, Interfile.
    """
    path = study(tmp_path / "a.dcm")
    frames = in_phases(tmp_path / "b.dcm", 10, 60)
    for file, angles, name, other, factors in (
        (path, ANGLES, "window2", "window1", "null"),
        (frames, (10.0, 190.0), "frame1", "frame6", "null"),
        (path, ANGLES, "window2", "window1", "{name: detector, time_s: 20}"),
    ):
        chosen = f"views.dataset={name}", f"joint=[{{views: {{dataset: {other}}}}}]"
        with pytest.raises(Refused, match="expected factors.branching"):
            scan(file, rig(*angles), *chosen, f"factors={factors}")


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


def test_the_energy_window_of_the_views_is_no_scatter_window(tmp_path: Path):
    """Of another file, whose window is by default that of the views, or of Interfile; a window
    without any counts is one. Also tried: tew with such an upper window.
    """
    path, other = study(tmp_path / "a.dcm"), tmp_path / "b.dcm"
    file = pydicom.dcmread(path)
    file.PixelData = (2 * np.frombuffer(file.PixelData, "<u2")).tobytes()
    file.save_as(other)
    chosen, dew = "views.dataset=window2", "scatter={{name: dew, lower: '{}'}}"
    with pytest.raises(Refused, match="b.dcm: expected the counts of another energy window"):
        scan(path, rig(*ANGLES), chosen, dew.format(other))
    assert scan(path, rig(*ANGLES), chosen, dew.format(f"{other}:/window1")).scatter.any()
    file.PixelData = bytes(len(file.PixelData))
    file.save_as(other)
    empty = scan(other, rig(*ANGLES), chosen, dew.format(f"{other}:/window1"))
    assert not empty.scatter.any()
    peak, same = (interfile(tmp_path / f"{n}.hs", n, kev=(126, 154)) for n in (9.0, 4.0))
    with pytest.raises(Refused, match="4.0.hs: expected the counts of another energy window"):
        scan(peak, rig(*ANGLES), dew.format(same))


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


PER_KEV, PEAK_KEV = 2.0, 28.0
WINDOWS = {"window1": 16.0, "window2": PEAK_KEV}


def window(path: Path, **changes: object) -> Path:
    """A study whose scatter has a flat spectrum: `PER_KEV` counts per keV in 20 s in each pixel of
    its first window; AcquisitionTime is noon.
    """
    changes = {"AcquisitionDate": "20240301", "AcquisitionTime": "120000"} | changes
    file = pydicom.dcmread(study(path, **changes))
    seconds = file.RotationInformationSequence[0].ActualFrameDuration / 1000
    kev = file.EnergyWindowInformationSequence[0].EnergyWindowRangeSequence[0]
    kev = float(kev.EnergyWindowUpperLimit) - float(kev.EnergyWindowLowerLimit)
    pixels = file.pixel_array.copy()
    pixels[[w == 1 for w in file.EnergyWindowVector]] = PER_KEV * kev * seconds / 20
    file.PixelData = pixels.astype("<u2").tobytes()
    file.save_as(path)
    return path


def lasting(seconds: float, path: Path) -> list:
    (turn,) = pydicom.dcmread(study(path)).RotationInformationSequence
    turn.ActualFrameDuration = int(1000 * seconds)
    return [turn]


@pytest.mark.parametrize("seconds", [20.0, 5.0, 80.0])
@pytest.mark.parametrize("upper", [False, True])
def test_scatter_of_a_flat_spectrum_is_that_of_the_main_window(tmp_path: Path, seconds, upper):
    """Two adjacent windows of one, in any time: the trapezium is exact, half of it without an
    upper window, and k = 28 / 16 of two windows is exact as well.
    """
    path = window(tmp_path / "a.dcm")
    other = window(
        tmp_path / "b.dcm", RotationInformationSequence=lasting(seconds, tmp_path / "c.dcm")
    )
    above = f", upper: '{other}:/window1'" if upper else ""
    for text, share in (
        (f"{{name: tew, lower: '{other}:/window1', widths_kev: [16, 28, 16]{above}}}", 1 / 2),
        (f"{{name: dew, lower: '{other}:/window1', k: 1.75}}", 1.0),
    ):
        if upper and "tew" in text:
            share = 1.0
        found = scan(path, rig(*ANGLES), "views.dataset=window2", f"scatter={text}").scatter
        assert torch.allclose(found, torch.tensor(share * PER_KEV * PEAK_KEV))


def interfile(path: Path, counts: float, *lines: str, kev: tuple = (98, 126)) -> Path:
    """Six views of 4 x 5 pixels of one number of counts in an energy window."""
    path.with_suffix(".s").write_bytes(torch.full((6, 4, 5), counts).numpy().tobytes())
    keys = [
        *("INTERFILE", "imaging modality := nucmed"),
        f"name of data file := {path.with_suffix('.s').name}",
        *("type of data := Tomographic", "imagedata byte order := LITTLEENDIAN"),
        *("number format := float", "number of bytes per pixel := 4", "number of projections := 6"),
        *("matrix axis label [1] := bin coordinate", "matrix size [1] := 5"),
        *("matrix axis label [2] := axial coordinate", "matrix size [2] := 4"),
        *("scaling factor (mm/pixel) [1] := 1.5", "scaling factor (mm/pixel) [2] := 2"),
        *(f"energy window lower level[1] := {kev[0]}", f"energy window upper level[1] := {kev[1]}"),
        *lines,
        "END OF INTERFILE",
    ]
    path.write_text("".join(f"!{key}{'' if ':=' in key else ' :='}\n" for key in keys))
    return path


def test_counts_of_interfile_are_scaled_by_the_durations_of_both_files(tmp_path: Path):
    """The duration is that of all views. Without it, or by NM of one view alone, counts are used as
    they are, with a warning; -1, as STIR writes it, is none.
    """
    path = interfile(tmp_path / "a.hs", 9.0, "image duration (sec)[1] := 600", kev=(126, 154))
    for seconds, share in ((300, 2.0), (600, 1.0)):
        other = interfile(tmp_path / "b.hs", 4.0, f"image duration (sec)[1] := {seconds}")
        found = scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}").scatter
        assert torch.allclose(found, torch.tensor(0.5 * 4.0 * share))
    for other in (
        interfile(tmp_path / "c.hs", 4.0, "image duration (sec)[1] := -1"),
        interfile(tmp_path / "d.hs", 4.0),
    ):
        with pytest.warns(UserWarning, match="taken to be of the duration of .*600 s and unknown"):
            found = scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}").scatter
        assert torch.allclose(found, torch.tensor(2.0))
    other = f"'{window(tmp_path / 'e.dcm')}:/window1'"
    with pytest.warns(UserWarning, match="taken to be of the duration of .*600 s and 20 s"):
        scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}")


@pytest.mark.parametrize("pixel_mm", [(2.0, 1.0), (1.5, 2.0), (20.0, 15.0)])
def test_pixels_of_interfile_are_those_of_the_cameras(pixel_mm, tmp_path: Path):
    """The scaling factors, in the order u, v, with rows and columns exchanged, or in another unit;
    0, which states none, is not compared.
    """
    path = interfile(tmp_path / "a.hs", 9.0)
    down, right = pixel_mm
    text = path.read_text()
    for axis, before, after in ((1, "1.5", right), (2, "2", down)):
        key = f"!scaling factor (mm/pixel) [{axis}] := "
        text = text.replace(f"{key}{before}\n", f"{key}{after}\n")
    scan(path, rig(*ANGLES))
    path.write_text(text)
    with pytest.raises(Refused, match=rf"file's pixels of {down:g} x {right:g} mm .*got 2 x 1.5"):
        scan(path, rig(*ANGLES))
    path.write_text(text.replace(f"[1] := {right}", "[1] := 0"))
    scan(path, rig(*ANGLES))


def test_the_extent_of_rotation_of_interfile_is_that_of_the_cameras(tmp_path: Path):
    """Cameras of a part of the extent, of a multiple, or in another order; both directions, any
    zero, and an extent that ends at the last view or behind it are right. 0 states nothing.
    Cameras of several heads or rings, whose extent may be that of each, are warned of.
    """
    turn = [60.0 * k for k in range(6)]
    path = interfile(tmp_path / "a.hs", 9.0, "extent of rotation := 360", "start angle := 180")
    for right in (turn, turn[::-1], [77 - angle for angle in turn], [a + 0.4 for a in turn]):
        scan(path, rig(*right))
    scan(path, rig(*(72.0 * k for k in range(6))))
    for wrong in ([a / 2 for a in turn], [2 * a for a in turn], [0.0] * 6):
        with pytest.raises(Refused, match="60 or 72 degrees .* 'extent of rotation' 360 of 6 pr"):
            scan(path, rig(*wrong))
    for unequal in (ANGLES, (*turn[:4], turn[5], turn[4])):
        with pytest.warns(UserWarning, match="60 or 72 degrees .* 'extent of rotation' 360 of 6"):
            scan(path, rig(*unequal))
    for world in ("LPS", "IEC"):  # with another axis of rotation
        InterfileViews(path).check_rig(from_world(rig(*turn), world))
        with pytest.raises(Refused, match="'extent of rotation' 360 of 6 .*, got 30 to 30"):
            InterfileViews(path).check_rig(from_world(rig(*(a / 2 for a in turn)), world))
    path = interfile(tmp_path / "b.hs", 9.0, "extent of rotation := 0")
    scan(path, rig(*ANGLES))


EACH = "time per projection (sec)"


def test_the_time_per_projection_of_interfile_is_the_duration_of_a_view(tmp_path: Path):
    """As SIMIND and GATE state it, alone or beside the duration of all views, as converters to STIR
    write it, or of one. 0 is none. Both files may state either.
    """
    path = interfile(tmp_path / "a.hs", 9.0, f"{EACH} := 20", kev=(126, 154))
    for lines, share in (
        ([f"{EACH} := 10"], 2.0),
        ([f"{EACH}[1] := 20", "image duration (sec)[1] := 120"], 1.0),
        ([f"{EACH} := 40", "image duration (sec) := 40", "study duration (sec) := 300"], 0.5),
        ([f"{EACH} := 0", "image duration (sec)[1] := 60"], 2.0),
    ):
        other = interfile(tmp_path / "b.hs", 4.0, *lines)
        found = scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}").scatter
        assert torch.allclose(found, torch.tensor(0.5 * 4.0 * share))
    other = interfile(tmp_path / "c.hs", 4.0, "study duration (sec) := 120")
    with pytest.warns(UserWarning, match="taken to be of the duration of .*20 s and unknown"):
        scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}")
    other = interfile(tmp_path / "d.hs", 4.0, f"{EACH} := 20", "image duration (sec)[1] := 240")
    with pytest.raises(Refused, match="'image duration .sec.' 120, the time per proj.*got 240"):
        scan(path, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}")
    with pytest.raises(Refused, match="factors.time_s=20 by the file, got 30"):
        scan(path, rig(*ANGLES), "factors={name: detector, branching: 0.9, time_s: 30}")


def test_windows_that_contradict_an_estimate_of_scatter(tmp_path: Path):
    """Widths in the files, the views themselves as a window, counts that are no whole numbers, and
    a window that is measured at another time. Unknown widths are those that are given.
    """
    path, chosen = window(tmp_path / "a.dcm"), "views.dataset=window2"
    other = f"'{path}:/window1'"
    for text, message in (
        (
            f"name: tew, lower: {other}, widths_kev: [15, 28, 16]",
            r"a.dcm:/window1.* 16 keV.*got 15",
        ),
        (f"name: tew, lower: {other}, widths_kev: [16, 20, 16]", r"a.dcm.* 28 keV .*got 20"),
        (
            f"name: tew, lower: {other}, upper: {other}, widths_kev: [16, 28, 10]",
            "16 keV .*got 10",
        ),
        (f"name: tew, lower: {other}, widths_kev: [16, 28]", "three window widths"),
        (f"name: dew, lower: {path}", "the counts of another energy window"),
        (f"name: tew, lower: '{path}:/window2', widths_kev: [4, 28, 4]", "another energy window"),
    ):
        with pytest.raises(ValueError, match=message):
            scan(path, rig(*ANGLES), chosen, f"scatter={{{text}}}")
    other = interfile(tmp_path / "b.hs", 4.5)
    main = interfile(tmp_path / "c.hs", 9.0, kev=(126, 154))
    with pytest.warns(UserWarning, match="expected whole numbers as the counts"):
        scan(main, rig(*ANGLES), f"scatter={{name: dew, lower: {other}}}")
    with pytest.raises(Refused, match="28 keV .*got 10"):
        scan(main, rig(*ANGLES), f"scatter={{name: tew, lower: {other}, widths_kev: [10, 28, 9]}}")
    for time, warned in (("120030", False), ("180000", True)):
        later = f"'{window(tmp_path / 'd.dcm', AcquisitionTime=time)}:/window1'"
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            scan(path, rig(*ANGLES), chosen, f"scatter={{name: dew, lower: {later}}}")
        assert any("6:00:00 h apart" in str(one.message) for one in caught) is warned


@pytest.mark.parametrize(
    ("frame", "slots", "warned"),
    [
        (214.25, (214.0, 215.0), False),  # 857 ms in 4 slots, rounded
        (None, (214.0, 215.0), False),
        (214.25, (None, None), False),
        (214.25, (214.25, 180.0), True),  # a shorter last slot
        (214.25, (100.0, 100.0), True),  # equal slots of another duration than nominal
        (100.0, (214.25, 214.25), True),
    ],
)
def test_slots_are_compared_with_their_nominal_time(tmp_path: Path, frame, slots, warned):
    items = [item(pydicom.Dataset, TimeSlotTime=slot) for slot in slots]
    interval = item(pydicom.Dataset, FrameTime=frame, TimeSlotInformationSequence=items)
    gate = item(pydicom.Dataset, DataInformationSequence=[interval])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(read_frames(study(tmp_path / "a.dcm", GatedInformationSequence=[gate])))
    assert ["TimeSlotTime" in str(one.message) for one in caught] == [True] * warned


def test_texts_that_state_corrections_of_counts_are_named(tmp_path: Path):
    """In one warning; not that of a codec."""
    for text, count in (("scatter corrected", 1), ("Lossless JPEG compression", 0)):
        path = study(tmp_path / "a.dcm", DerivationDescription=text, ImageComments="rest, supine")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            open_projections(path, dataset="window2")
        assert [text in str(one.message) for one in caught] == [True] * count
