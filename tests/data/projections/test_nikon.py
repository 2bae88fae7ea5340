"""Nikon's .xtekct: geometry, images and white level, as the Core Imaging Library reads them."""

import math
import warnings

import numpy as np
import pytest
import tifffile
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats import nikon
from tests.data.projections.conftest import opened

ENTRIES = {
    "Name": "tooth",
    "InputSeparator": "_",
    "InputFolderName": "",
    "Projections": 3,
    "SrcToObject": 100.0,
    "SrcToDetector": 400.0,
    "DetectorPixelsX": 6,
    "DetectorPixelsY": 4,
    "DetectorPixelSizeX": 0.5,
    "DetectorPixelSizeY": 0.25,
    "InitialAngle": 10.0,
    "AngularStep": 30.0,
    "ObjectOffsetX": 0.0,
    "WhiteLevel": 60000,
    "Units": "mm",
    "Shuttling": "False",
}


def xtekct(folder, **changed):
    """A header; entries of None are left out."""
    lines = [f"{k}={v}" for k, v in (ENTRIES | changed).items() if v is not None]
    path = folder / "tooth.xtekct"
    path.write_text("\r\n".join(["[XTekCT]", *lines, "[CTPro]", "Projections=99", ""]), "latin-1")
    return path


def images(folder, values, name="tooth", ending="tif"):
    for k, view in enumerate(values, 1):
        tifffile.imwrite(folder / f"{name}_{k:04}.{ending}", view)
    return folder


def cil(point, entries):
    """The pixel (column, row) of a point of CIL's world on each of its panels, by its vectors:
    source and detector turn by InitialAngle - 180 + k AngularStep; the first pixel is at the upper
    right; the axis is at (-ObjectOffsetX, SrcToObject).
    """
    places = []
    for k in range(entries["Projections"]):
        a = math.radians(entries["InitialAngle"] - 180 + k * entries["AngularStep"])
        turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
        x, y, z = turn.T @ point + [-entries["ObjectOffsetX"], entries["SrcToObject"], 0]
        scale = entries["SrcToDetector"] / y
        columns, rows = entries["DetectorPixelsX"], entries["DetectorPixelsY"]
        column = (columns - 1) / 2 - scale * x / entries["DetectorPixelSizeX"]
        places.append([column, (rows - 1) / 2 - scale * z / entries["DetectorPixelSizeY"]])
    return np.array(places)


@pytest.mark.parametrize("aside", [0.0, 0.3])
def test_points_are_projected_as_by_the_core_imaging_library(aside, tmp_path):
    """With the columns reversed, as the views are."""
    entries = ENTRIES | {"ObjectOffsetX": aside}
    cameras = nikon.read(xtekct(tmp_path, ObjectOffsetX=aside))
    point = torch.tensor([[0.4, -0.7, 0.1]], dtype=torch.float64)
    u, v = cameras.project(point)[:, 0, :2].T
    expected = cil(point[0].numpy(), entries)
    assert np.allclose(5 - u.numpy(), expected[:, 0]) and np.allclose(v.numpy(), expected[:, 1])


def test_the_centre_of_rotation_stands_for_the_offset_and_the_roll(tmp_path):
    """On the detector, 400 / 100 times as large; a roll leans the axis by their difference."""
    other = nikon.read(xtekct(tmp_path, ObjectOffsetX=0.3))
    ends = {"CentreOfRotationTop": 1.2, "CentreOfRotationBottom": 1.2}
    assert torch.allclose(
        nikon.read(xtekct(tmp_path, ObjectOffsetX=None, **ends)).source, other.source
    )
    roll = math.degrees(math.atan2(-0.1, 1.0))
    leant = nikon.read(xtekct(tmp_path, ObjectOffsetX=0.3, ObjectRoll=roll))
    ends = {"CentreOfRotationTop": 1.25, "CentreOfRotationBottom": 1.15}
    same = nikon.read(xtekct(tmp_path, ObjectOffsetX=None, **ends))
    assert torch.allclose(same.source, leant.source) and torch.allclose(same.u, leant.u)
    assert not torch.allclose(leant.u, other.u)


@pytest.mark.parametrize("folder", ["", "tooth", "C:\\\\data", "../elsewhere"])
def test_the_images_of_nikon_are_found_and_mirrored(folder, tmp_path):
    """Beside the file, or in its folder inside; fields of one's own are mirrored as the views."""
    home = tmp_path / "scan"
    home.mkdir()
    values = np.arange(1, 73, dtype="u2").reshape(3, 4, 6) * 500
    (home / "tooth").mkdir()
    images(home / "tooth" if folder == "tooth" else home, values)
    views = opened(xtekct(home, InputFolderName=folder))
    mirrored = values[..., ::-1].copy()
    expected = torch.from_numpy(-np.log(mirrored / 60_000)).float()
    assert torch.allclose(views.whole().views, expected, atol=1e-6)
    assert views.stack.rig == {"name": "nikon", "path": str(home / "tooth.xtekct")}
    np.save(tmp_path / "flat.npy", values[0] + 40_000)
    views = opened(home / "tooth.xtekct", flat=tmp_path / "flat.npy")
    expected = torch.from_numpy(-np.log(mirrored / (mirrored[0] + 40_000))).float()
    assert torch.allclose(views.whole().views, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "ending"), [("tooth", "TIF"), ("Zahnröhre", "tiff"), ("a[1] b", "Tiff")]
)
def test_names_of_nikon_have_any_characters_and_case(name, ending, tmp_path):
    """In the bytes of Latin-1, as Windows stores them in the header; also tried: UTF-8."""
    values = np.full((3, 4, 6), 30_000, "u2")
    images(tmp_path, values, name, ending)
    assert len(opened(xtekct(tmp_path, Name=name)).whole().views) == 3


@pytest.mark.parametrize("ends", [("Top",), ("Bottom",), ("",), ("Top", "Bottom", "")])
def test_one_centre_of_rotation_leans_no_axis(ends, tmp_path):
    """A centre that is missing is the other, as in older files."""
    other = nikon.read(xtekct(tmp_path, ObjectOffsetX=0.3))
    centres = {f"CentreOfRotation{end}": 1.2 for end in ends}
    rig = nikon.read(xtekct(tmp_path, ObjectOffsetX=None, **centres))
    assert torch.allclose(rig.source, other.source) and torch.allclose(rig.u, other.u)
    with pytest.warns(UserWarning, match="ObjectOffsetX 0 is taken .* at 0.3 mm"):
        nikon.read(xtekct(tmp_path, ObjectOffsetX=0.0, **centres))


REFUSED = {
    "no step": ({"AngularStep": 0.0}, "expected an AngularStep between 3 Projections, got 0"),
    "a distance twice": ({"SRCTOOBJECT": 150.0}, "one srctoobject, got 100.0 and 150.0"),
    "cm": ({"Units": "cm"}, "expected Units mm, got 'cm'"),
    "shuttling": ({"Shuttling": "True"}, "expected Shuttling"),
    "a shifted detector": ({"DetectorOffsetX": 2.5}, "expected DetectorOffsetX"),
    "no distance": ({"SrcToObject": None}, "expected the entry SrcToObject"),
    "a detector before the axis": ({"SrcToDetector": 50}, "expected 0 < SID < SDD"),
    "inverted images": ({"InvertedImages": "True"}, "expected InvertedImages .*got 'True'"),
    "measured angles": ({"AngleFile": "tooth.ang"}, "expected AngleFile .*got 'tooth.ang'"),
    "angles of one's own": ({"Angles": "custom"}, "expected Angles equal .*got 'custom'"),
    "normalised flux": ({"FluxNormalisation": "true"}, "expected FluxNormalisation"),
    "no number": ({"AngularStep": "x"}, "AngularStep"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_an_xtekct_that_is_not_applied_is_refused_by_name(fault, tmp_path):
    entries, message = REFUSED[fault]
    with pytest.raises(Refused, match=message):
        nikon.read(xtekct(tmp_path, **entries))


def test_an_empty_xtekct_is_refused(tmp_path):
    (tmp_path / "a.xtekct").touch()
    with pytest.raises(Refused, match="got none"):
        nikon.read(tmp_path / "a.xtekct")


def test_images_of_another_size_are_refused(tmp_path):
    images(tmp_path, np.ones((3, 4, 5), "u2"))
    with pytest.raises(Refused, match=r"states \(4, 6\) pixels"):
        opened(xtekct(tmp_path))


def test_unknown_entries_are_warned_of(tmp_path):
    """Levels, gains, tilts, shifts, directions, paths and any other, but not the entries of public
    files of Nikon's, nor those that say nothing.
    """
    for name, value in {
        **{"BlackLevel": 500, "GreyOffset": 9, "GainCorrection": 2, "DetectorTilt": 3},
        **{"DetectorRoll": 0.5, "SourceOffsetX": 2, "ObjectOffsetZ": 3, "ImageRotation": 90},
        **{"RotationDirection": "CW", "FlipHorizontal": "True", "AngularUnits": "rad"},
        **{"PixelBinning": 2, "HelixPitch": 10, "ZStep": 0.3, "ConveyorSpeed": 5},
        **{"ScanType": "Helical", "IncrementalAngle": -60, "StartAngle": 90},
        **{"ReversedImages": "True", "DetectorBinning": "2x2", "PanelSkew": 2, "LogImages": 1},
    }.items():
        with pytest.warns(UserWarning, match=f"know: {name.lower()};"):
            nikon.read(xtekct(tmp_path, **{name: value}))
    own = {"OffsetZ": 4, "Scaling": 1000, "OutputUnits": "/m", "TIFFScaling": 1, "Scale": 1.32}
    own |= {"AutomaticCentreOfRotation": 1, "AutoScalingType": 2, "ImportConversion": 1}
    own |= {"InvertedImages": "False", "Angles": "Equidistant"}
    own |= {"FluxNormalisation": 0, "FramesPerProjection": 4, "Increment": 1, "OrderFFT": 3}
    own |= {"VirtualDetectorPixelsX": 6, "SrcToVirtualDetector": 400.0, "Blanking": 0}
    own |= {"AutomaticCentreOfRotationMaskRadius": 3.0, "OperatorID": "a", "OutputDigits": 4}
    own |= {"DetectorBinning": 0, "LowPercentile": 0.2, "VoxelSizeY": 0.1, "RegionPixelsY": 4}
    own |= {"MedianFilterKernelSize": 1, "BeamHardeningLUTFile": "a.lut", "CoefX1": 0.75}
    with warnings.catch_warnings(action="error"):
        for none in ("", "none", "NONE"):
            own |= {"AngleFile": none}
            nikon.read(xtekct(tmp_path, **own, BlackLevel=0, Conveyor="False", DetectorTilt=""))


def test_entries_of_ctpro_count_as_those_of_the_scan(tmp_path):
    """Those of how images were taken: shuttling is refused, and a file of angles named. Others are
    named if they would count in the scan's own section, and say something else.
    """
    path = xtekct(tmp_path, Shuttling=None)
    own = path.read_text("latin-1")
    path.write_text(f"{own}Shuttling=True\r\n", "latin-1")
    with pytest.raises(Refused, match="expected Shuttling"):
        nikon.read(path)
    path.write_text(f"{own}AngleFile_Use=True\r\n", "latin-1")
    with pytest.warns(UserWarning, match="know: anglefile_use;"):
        nikon.read(path)
    path.write_text(f"{own}AngleFile_Use=False\r\nVoxelScalingFactor=2\r\n", "latin-1")
    with warnings.catch_warnings(action="error"):
        nikon.read(path)
        step = nikon.header(path).number("AngularStep")
        (tmp_path / "a.ang").write_text("".join(f"{k}: {k * step}\n" for k in range(9)))
        path.write_text(f"{own}AngleFile_Use=True\r\n", "latin-1")
        nikon.read(path)  # its steps are compared
        path.write_text(
            f"{own}AngularStep={nikon.header(path).texts['angularstep']}\r\n", "latin-1"
        )
        nikon.read(path)
    for entry in ("FluxNormalisation=True", "AngularStep=-30", "CentreOfRotationTop=3.0"):
        path.write_text(f"{own}{entry}\r\n", "latin-1")
        name = entry.partition("=")[0].lower()
        with pytest.warns(UserWarning, match=rf"know: \[ctpro\] {name};"):
            nikon.read(path)


def test_entries_of_sections_that_no_reader_knows_are_named(tmp_path):
    """As Nikon's scatter correction writes its own; not those of the tube and of texts."""
    path = xtekct(tmp_path)
    own = path.read_text("latin-1")
    known = "[Xrays]\nXraykV=90\n[DICOM]\nDICOMTags=<scale>2</scale>\n[ScatterCorrection]\n"
    path.write_text(f"{own}{known}VeilingGlareApplied=0\n", "latin-1")
    with warnings.catch_warnings(action="error"):
        nikon.read(path)
    path.write_text(f"{own}{known}VeilingGlareApplied=1\n[Helix]\nPitch=3\n", "latin-1")
    named = r"know: \[scattercorrection\] veilingglareapplied, \[helix\] pitch;"
    with pytest.warns(UserWarning, match=named):
        nikon.read(path)


@pytest.mark.parametrize(
    ("name", "text", "warned"),
    [
        ("tooth.ang", "1:\t10.0\n2:\t20.0\n3:\t70.0\n", True),
        ("_ctdata.txt", "Projection Angle Time\n1 10.0 0.5\n2 20.0 1\n3 40.2 1.5\n", True),
        ("tooth.ang", "3:\t70.0\n2:\t40.01\n1:\t10.0\n", False),
        ("_ctdata.txt", "Projection Angle Time\n1 350.0 0.5\n2 20.0 1\n3 50.0 1.5\n", False),
        ("_ctdata.txt", "no angles\n", False),
        ("_ctdata.txt", "Projs Start\n3 -180\nProj Angle\n1 10 0\n2 40 1\n3 70 2\n", False),
        ("_ctdata.txt", "Projs Start\n3 -180\nProj Angle\n1 10 0\n2 20 1\n3 70 2\n", True),
    ],
)
def test_measured_angles_in_other_steps_are_warned_of(name, text, warned, tmp_path):
    """Those in the steps of the header, in either order and over a full turn, are not."""
    path = xtekct(images(tmp_path, np.full((3, 4, 6), 3000, "u2")))
    (tmp_path / name).write_text(text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nikon.read(path)
    assert any(f"{name}: states steps of" in str(one.message) for one in caught) is warned
