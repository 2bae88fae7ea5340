"""Geometry files that are wrong are refused with the reason."""

import json
import math

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats import angles, astra, rtk_xml, tigre
from tests.geometry.cameras.rigs import DETECTOR

XML = """<?xml version="1.0"?>
<!DOCTYPE RTKGEOMETRY>
<RTKThreeDCircularGeometry version="3">
<SourceToIsocenterDistance>400</SourceToIsocenterDistance>
<SourceToDetectorDistance>800</SourceToDetectorDistance>
{}</RTKThreeDCircularGeometry>
"""
VIEW = "<Projection><GantryAngle>{}</GantryAngle></Projection>\n"
RADIANS = [k * math.pi / 8 for k in range(16)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML.format(VIEW.format(10))[:-40], "no element found|not an RTK geometry"),
        (XML.format("".join(map(VIEW.format, RADIANS))), "look like radians"),
        (XML.replace("400", "900").format(VIEW.format(10)), "SID < SDD"),
        (XML.format(VIEW.format("nan")), "a finite number for GantryAngle, got 'nan'"),
        (XML.format(""), "1 to 65536 projections, got 0"),
        (XML.replace("3", "2").format(VIEW.format(1)), "version 3"),
        (
            XML.format(VIEW.format("&a;")).replace("GEOMETRY>", 'GEOMETRY [<!ENTITY a "1">]>', 1),
            "no entities",
        ),
        (
            XML.format(VIEW.format(1)).replace(
                "<Proj", "<RadiusCylindricalDetector>9</RadiusCylindricalDetector><Proj", 1
            ),
            "flat detector",
        ),
        (XML.format("<Zoom>1</Zoom>"), "got 'Zoom'"),
        ("<html/>", "RTKThreeDCircularGeometry of version 3"),
    ],
)
def test_xml_that_is_not_a_rig_is_refused(text, message, tmp_path):
    """RTK's XML that is cut short, in radians, with SID > SDD, or with entities is refused with the
    reason.
    """
    path = tmp_path / "rig.xml"
    path.write_text(text)
    with pytest.raises(Refused, match=message):
        rtk_xml.read(path, DETECTOR)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("angle_degrees,sid_mm\n" + ",400\n".join(map(str, RADIANS)) + ",400", "like radians"),
        ("angle_degrees,sid_mm\n1,900\n", "SID < SDD"),
        ("angle_degree,sid_mm\n1,400\n", "did you mean 'angle_degrees'"),
        ("angle_degrees,sid_mm\n1\n", "1 to 65536 lines of 2 numbers"),
        ("angle_degrees,sid_mm\n1,inf\n", "finite number for sid_mm of view 0"),
        ("angle_degrees\n1\n", "expected sid_mm, a column"),
        ("", "lines of 0 numbers"),
    ],
)
def test_tables_that_are_not_rigs_are_refused(text, message, tmp_path):
    """A table of angles in radians, with SID > SDD, or with an unknown or missing column is refused
    with the reason.
    """
    path = tmp_path / "rig.csv"
    path.write_text(text)
    with pytest.raises(Refused, match=message):
        angles.read(path, DETECTOR, sdd_mm=800.0)


def test_a_small_arc_in_degrees_can_be_forced(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("angle_degrees\n" + "\n".join(map(str, RADIANS)))
    assert len(angles.read(path, DETECTOR, 400.0, 800.0, small_arc=True)) == len(RADIANS)


def test_vectors_and_json_that_are_not_rigs_are_refused(tmp_path):
    """ASTRA's vectors and TIGRE's JSON that are cut short, not finite, in degrees, or pickled are
    refused with the reason.
    """
    path = tmp_path / "rig"
    for text, message in (("1 2 3", "lines of 12"), ("1 " * 11 + "nan", "line 1"), ("", "0 lines")):
        path.write_text(text)
        with pytest.raises(Refused, match=message):
            astra.read(path, [6, 9])
    record = {"DSD": 800, "DSO": 400, "nDetector": [6, 9], "dDetector": [2, 3], "angles": [1.0]}
    for change, message in (
        ({"angles": [0.0, 180.0]}, "are they degrees"),
        ({"DSO": 900}, "SID < SDD"),
        ({"angles": "1e9"}, "numbers for angles"),
        ({"offDetector": [[1, 2]] * 2}, "one for each of 1 views"),
        ({"DSDs": 1}, "did you mean 'DSD'"),
        ({"DSD": float("nan")}, "finite numbers for DSD"),
    ):
        path.write_text(json.dumps({**record, **change}))
        with pytest.raises(Refused, match=message):
            tigre.read(path)
    np.save(tmp_path / "rig.npy", np.array([{}] * 12, dtype=object), allow_pickle=True)
    with pytest.raises(Refused, match="floating"):
        astra.read(tmp_path / "rig.npy", [6, 9])
    np.save(tmp_path / "cut.npy", np.zeros((3, 12)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cut.npy").read_bytes()[:-8])
    with pytest.raises(Refused, match="another length"):
        astra.read(tmp_path / "cut.npy", [6, 9])
