"""What the plugin writes is read back: Interfile, DICOM NM, STIR's systems."""

from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st

import mvrecon as mv
from mvrecon.core.files.checks import Refused
from mvrecon.core.numbers import generator
from mvrecon.data.resample import right_angled
from mvrecon.data.volume_files import save_volume
from mvrecon_spect.files.interfile_volume import (
    read_interfile,
    read_mu,
    write_interfile_volume,
    write_mu,
)
from mvrecon_spect.files.nm import read_nm
from mvrecon_spect.files.nm_volume import NmVolume, read_nm_volume, write_nm
from mvrecon_spect.files.stir import StirScan, read_stir, write_stir
from mvrecon_spect.files.stir_system import StirSystem
from mvrecon_spect.files.stir_text import CollimatorText, DetectorText, Opening, Ring
from tests.properties.round_trips import Format, Placed, placed, same_places, upright
from tests.properties.strategies import SEEDS, real

pydicom = pytest.importorskip("pydicom")
pytest.importorskip("nibabel")

#: Relative rounding of 1/mm -> 1/cm -> 1/mm in float32.
ROUNDING = 2.0**-22


def attenuation(x: Placed) -> Placed:
    """The volume as attenuation in 1/mm of tissue."""
    volume, grid = x
    most = volume.abs().max()
    return (volume.abs() / most * 0.02 if 0 < most < 1e30 else torch.full_like(volume, 0.015)), grid


@dataclass(frozen=True)
class Study:
    """A volume, its unit, and the study that it was made from: start, duration of a view, dose, and
    where the file states the duration.
    """

    volume: Placed
    unit: str
    start: datetime | None
    duration_s: float | None
    dose_mbq: float | None
    turns: bool


@st.composite
def studies(draw: st.DrawFn) -> Study:
    first, last = datetime(1995, 1, 1), datetime(2035, 1, 1)
    return Study(
        draw(placed()),
        draw(st.sampled_from(["{counts}/mm3", "Bq/ml", "1"])),
        draw(st.none() | st.datetimes(first, last)),
        draw(st.none() | st.integers(1, 10**7).map(lambda ms: ms / 1000)),
        draw(st.none() | real(1, 2000).map(lambda dose: float(f"{dose:.9g}"))),
        draw(st.booleans()),
    )


def write_study(folder: Path, x: Study) -> None:
    """The study is a file of another scanner, which holds only what it knows."""
    from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.20"
    meta.MediaStorageSOPInstanceUID = generate_uid()
    study = FileDataset("study", {}, file_meta=meta, preamble=bytes(128))
    study.SpecificCharacterSet, study.PatientName = "ISO_IR 192", "Müller^Zoë"
    study.Modality, study.Rows, study.Columns, study.PatientWeight = "NM", 4, 4, "71.5"
    agent, turn = Dataset(), Dataset()
    if x.start is not None:
        study.AcquisitionDate = x.start.strftime("%Y%m%d")
        study.AcquisitionTime = x.start.strftime("%H%M%S.%f")
    if x.duration_s is not None:
        where = turn if x.turns else study
        where.ActualFrameDuration = round(1000 * x.duration_s)
    if x.dose_mbq is not None:
        agent.RadionuclideTotalDose = f"{x.dose_mbq:.9g}"
    study.RadiopharmaceuticalInformationSequence = [agent]
    study.RotationInformationSequence = [turn]
    path = folder.parent / f"{folder.name}.study.dcm"
    study.save_as(path, enforce_file_format=True)
    write_nm(folder / "a.dcm", *x.volume, like=path, unit=x.unit)


def same_study(x: Study, y: NmVolume) -> None:
    values = x.volume[0]
    most = values.abs().max().item()
    step = (values.max().clamp_min(0) - values.min().clamp_max(0)).item() / 65535
    same_places(x.volume, (y.volume, y.grid), 0.51 * step + 1e-6 * most, voxels=1e-3)
    assert (y.unit, y.start, y.duration_s, y.dose_mbq) == (
        x.unit,
        x.start,
        x.duration_s,
        x.dose_mbq,
    )


def holds_nm(x: Study) -> bool | None:
    """Axes at right angles, and values of which 65535 steps are numbers of float32."""
    volume, grid = x.volume
    spread = (volume.max().clamp_min(0) - volume.min().clamp_max(0)).item()
    if 0 < spread < 1e-33:
        return False
    axes = grid.affine[:3, :3] / grid.affine[:3, :3].norm(dim=0)
    skew = (axes.T @ axes - torch.eye(3, dtype=axes.dtype)).abs().max()
    return True if skew < 1e-9 else None if right_angled(grid) else False


@st.composite
def scans(draw: st.DrawFn) -> StirScan:
    """A ring of detectors with holes of all kinds; numbers are of numpy's types, too."""
    count, kind = draw(st.integers(1, 5)), draw(st.sampled_from([float, np.float64]))
    angle, step = draw(real(-180, 180)), draw(real(10, 70))
    model, sense = draw(st.sampled_from(["pol", "cyl"])), draw(st.sampled_from([-1, 1]))

    def hole(detector: int) -> Opening:
        x = draw(real(-2, 2)) + (angle + sense * detector * step if model == "cyl" else 0.0)
        return Opening(
            detector,
            (kind(x), kind(draw(real(-3, 3))), kind(draw(real(-3, 3)))),
            draw(st.sampled_from(["round", "rect"])),
            (kind(draw(real(0.1, 3))), kind(draw(real(0.1, 3)))),
            (kind(draw(real(-9, 9))), 0.0),
            (kind(draw(real(10, 60))), 45.0),
        )

    shape = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    system = StirSystem(
        shape,
        (kind(draw(real(0.1, 5))), kind(draw(real(0.1, 5)))),
        kind(draw(real(45, 99))),
        DetectorText(kind(0.4), kind(3.0), kind(0.44), (Ring(count, kind(angle), sense * step),)),
        CollimatorText(model, kind(28.0), kind(10.0), tuple(map(hole, range(count)))),
    )
    rng = generator(0, draw(SEEDS))
    return StirScan(system, torch.poisson(torch.full((1, 1, count, *shape), 7.0), generator=rng))


def numbers(x: Any) -> list[Any]:
    """The leaves of nested lists, tuples and mappings."""
    if isinstance(x, dict):
        x = list(x.values())
    return [leaf for one in x for leaf in numbers(one)] if isinstance(x, list | tuple) else [x]


def same_scan(x: StirScan, y: StirScan) -> None:
    assert torch.equal(x.counts, y.counts)
    for one, other in zip(*(numbers(asdict(z.system)) for z in (x, y)), strict=True):
        assert one == (other if isinstance(one, str) else pytest.approx(other, rel=1e-12))


FORMATS = {
    "volume.hv": Format(
        placed(),
        lambda folder, x: write_interfile_volume(folder / "a.hv", *x),
        lambda folder, x: read_interfile(folder / "a.hv"),
        same_places,
        lambda x: upright(x[1]),
    ),
    "mu.hv": Format(
        placed().map(attenuation),
        lambda folder, x: write_mu(folder / "a.hv", *x),
        lambda folder, x: read_mu(folder / "a.hv"),
        lambda x, y: same_places(x, y, relative=ROUNDING),
        lambda x: upright(x[1]),
    ),
    "volume.dcm": Format(
        studies(),
        write_study,
        lambda folder, x: read_nm_volume(folder / "a.dcm"),
        same_study,
        holds_nm,
    ),
    "counts.hs": Format(
        scans(), write_stir, lambda folder, x: read_stir(folder / "counts.hs"), same_scan
    ),
}


@pytest.mark.parametrize("name", FORMATS)
@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
@pytest.mark.filterwarnings("ignore:.*is the file in 1/mm")
def test_what_is_written_is_read_back(name, data, tmp_path_factory):
    """As the test of the same name of mvrecon's own formats: grids off the origin, of unequal
    spacing, turned, mirrored in pairs of axes or sheared, with unit, start, duration and dose.

    Tried beside these: NaN, values beyond float32 or too small for 16 bits, a name with ';', a CT
    or several windows as `like`; see below.
    """
    FORMATS[name].check(data, tmp_path_factory.mktemp("format"))


GRID = mv.Grid.centred(size=(4, 5, 6), spacing=(1.0, 2.0, 3.0), centre=(40.0, -40.0, 7.0))


@pytest.mark.parametrize(
    ("write", "name", "value", "message"),
    [
        (write_interfile_volume, "a.hv", torch.nan, "got 120 that are not in float32"),
        (write_interfile_volume, "a.hv", 1e300, "got 120 that are not in float32"),
        (write_interfile_volume, "a;b.hv", 1.0, "a name without ';'"),
        (write_interfile_volume, " a.hv", 1.0, "without blanks"),
        (write_nm, "a.dcm", 1e300, "greatest of float32"),
        (write_nm, "a.dcm", 1e-40, "16 bits with a slope"),
        (write_nm, "a.dcm", 3e38, "16 bits with a slope"),  # of both signs
    ],
)
def test_contents_that_are_refused(write, name, value, message, tmp_path: Path):
    x = torch.full(GRID.shape, value, dtype=torch.float64)
    x[0] *= -1
    with pytest.raises(ValueError, match=message):
        write(tmp_path / name, x, GRID)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_attenuation_of_any_precision_keeps_its_digits(dtype, tmp_path: Path):
    """Also tried: views and volumes in these, not contiguous, that require gradients."""
    mu = (0.02 * torch.rand(GRID.shape)).to(dtype)
    write_mu(tmp_path / "mu.hv", mu, GRID)
    found = read_mu(tmp_path / "mu.hv")[0]
    torch.testing.assert_close(found, mu.float(), rtol=ROUNDING, atol=0)


def test_a_dicom_volume_is_read_as_any_other(tmp_path: Path, parts: None):
    """`mv.read_volume`, and so `grid.like`; views of a camera are refused, as are slices of
    several volumes.
    """
    x = torch.rand(GRID.shape)
    save_volume(tmp_path / "a.dcm", x, GRID, unit="activity")
    volume, grid = mv.read_volume(tmp_path / "a.dcm")
    torch.testing.assert_close(grid.affine, GRID.affine)
    assert (volume - x).abs().max() < 1e-5
    with pytest.raises(Refused, match="the slices of a volume"):
        read_nm(tmp_path / "a.dcm")
    dataset = pydicom.dcmread(tmp_path / "a.dcm")
    dataset.SliceVector = [1, 2, 3, 1, 2, 3]
    dataset.save_as(tmp_path / "b.dcm")
    with pytest.raises(Refused, match="got 3 of 6; read_nm reads measured views"):
        mv.read_volume(tmp_path / "b.dcm")
    # slices in another order, downwards
    dataset.SliceVector, dataset.SpacingBetweenSlices = [6, 5, 4, 3, 2, 1], -3.0
    frames = dataset.pixel_array
    dataset.PixelData = np.ascontiguousarray(frames[::-1]).tobytes()
    detector = dataset.DetectorInformationSequence[0]
    there = read_nm_volume(tmp_path / "a.dcm").grid.affine
    expected = there[2, 3].item() + 15.0
    detector.ImagePositionPatient[2] = expected
    dataset.PixelData = np.ascontiguousarray(frames).tobytes()
    dataset.save_as(tmp_path / "c.dcm")
    down, below = mv.read_volume(tmp_path / "c.dcm")
    torch.testing.assert_close(below.affine, GRID.affine)
    torch.testing.assert_close(down, volume)


@pytest.mark.parametrize(
    ("changes", "start", "duration_s", "dose_mbq"),
    [
        ({"AcquisitionTime": "0815"}, datetime(2024, 2, 29, 8, 15), 25.0, 740.0),
        ({"AcquisitionTime": None}, None, 25.0, 740.0),
        (
            {"AcquisitionDateTime": "20240301093000.5+0100"},
            datetime(2024, 3, 1, 9, 30, 0, 500000),
            25.0,
            740.0,
        ),
        ({"ActualFrameDuration": 30000}, datetime(2024, 2, 29, 8, 15, 30), None, 740.0),
        ({"agents": 2}, datetime(2024, 2, 29, 8, 15, 30), 25.0, None),
    ],
)
def test_times_and_doses_of_other_scanners(changes, start, duration_s, dose_mbq, tmp_path: Path):
    """A time without seconds or a date, a date and time with a zone, two durations, two doses: of
    several none is returned.
    """
    volume = torch.rand(GRID.shape), GRID
    study = Study(volume, "1", datetime(2024, 2, 29, 8, 15, 30), 25.0, 740.0, True)
    (tmp_path / "x").mkdir()
    write_study(tmp_path / "x", study)
    source = pydicom.dcmread(tmp_path / "x.study.dcm", force=True)
    for name, value in changes.items():
        if name == "agents":
            other = pydicom.Dataset()
            other.RadionuclideTotalDose = "111"
            source.RadiopharmaceuticalInformationSequence.append(other)
        elif value is None:
            delattr(source, name)
        else:
            setattr(source, name, value)
    source.save_as(tmp_path / "like.dcm")
    write_nm(tmp_path / "a.dcm", *volume, like=tmp_path / "like.dcm")
    found = read_nm_volume(tmp_path / "a.dcm")
    assert (found.start, found.duration_s, found.dose_mbq) == (start, duration_s, dose_mbq)


def test_a_volume_copies_the_acquisition_of_its_own_modality_alone(tmp_path: Path):
    """A CT has another time and no dose in MBq; of two energy windows none is known to be that of
    the volume.
    """
    volume = torch.rand(GRID.shape), GRID
    study = Study(volume, "1", datetime(2024, 2, 29, 8, 15, 30), 25.0, 740.0, True)
    (tmp_path / "x").mkdir()
    write_study(tmp_path / "x", study)
    source = pydicom.dcmread(tmp_path / "x.study.dcm", force=True)
    window = pydicom.Dataset()
    for count in (1, 2):
        source.EnergyWindowInformationSequence = [window] * count
        source.save_as(tmp_path / "like.dcm")
        write_nm(tmp_path / "a.dcm", *volume, like=tmp_path / "like.dcm")
        made = pydicom.dcmread(tmp_path / "a.dcm")
        assert len(made.EnergyWindowInformationSequence) == (count == 1)
        assert made.PatientName == "Müller^Zoë" and made.PatientWeight == 71.5
    source.Modality = "CT"
    source.save_as(tmp_path / "like.dcm")
    write_nm(tmp_path / "a.dcm", *volume, like=tmp_path / "like.dcm")
    found = read_nm_volume(tmp_path / "a.dcm")
    assert (found.start, found.duration_s, found.dose_mbq) == (None, None, None)
    assert pydicom.dcmread(tmp_path / "a.dcm").PatientName == "Müller^Zoë"
