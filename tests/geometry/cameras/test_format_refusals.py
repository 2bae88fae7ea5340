"""Geometry files that are wrong are refused with the reason."""

import json
import math
import re
import warnings

import numpy as np
import pytest

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats import angles, astra, rtk_xml, tigre
from mvrecon.geometry.cameras.rigs import circular
from tests.geometry.cameras.rigs import DETECTOR, same

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
        ({"angles": [0.0, 180.0]}, "degrees=true .camera.degrees. if they are degrees"),
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
    with pytest.raises(Refused, match="Python objects"):
        astra.read(tmp_path / "rig.npy", [6, 9])
    np.save(tmp_path / "cut.npy", np.zeros((3, 12)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cut.npy").read_bytes()[:-8])
    with pytest.raises(Refused, match="cut short"):
        astra.read(tmp_path / "cut.npy", [6, 9])


#: The example of RTK's documentation (3DGeometry), without its cylindrical detector.
DOCUMENTED = """<?xml version="1.0"?>
<!DOCTYPE RTKGEOMETRY>
<RTKThreeDCircularGeometry version="3">
  <SourceToIsocenterDistance>1000</SourceToIsocenterDistance>
  <SourceToDetectorDistance>1536</SourceToDetectorDistance>
  <Projection>
    <GantryAngle>271.847274780273</GantryAngle>
    <ProjectionOffsetX>-117.056503295898</ProjectionOffsetX>
    <ProjectionOffsetY>-1.01195001602173</ProjectionOffsetY>
    <Matrix>
          -166.5093078829                   0   -1531.42837748039   -117056.503295898
        -1.01142410874151               -1536  0.0326206557691505   -1011.95001602173
       -0.999480303105996                   0  0.0322354417240802               -1000
    </Matrix>
  </Projection>
</RTKThreeDCircularGeometry>
"""


@pytest.mark.parametrize("digits", [15, 9, 7])
def test_a_matrix_that_agrees_with_its_projection_is_accepted(digits, tmp_path):
    """RTK's own example; and with its numbers rounded to fewer digits, relative errors of 5e-7."""
    text = re.sub(r"-?\d+\.\d+(?=[\s<])", lambda m: f"{float(m[0]):.{digits}g}", DOCUMENTED)
    (tmp_path / "rig.xml").write_text(text)
    assert len(rtk_xml.read(tmp_path / "rig.xml", DETECTOR)) == 1


@pytest.mark.pairwise(change=[1e-6, -1e-6], place=range(12))
def test_a_matrix_with_relative_rounding_errors_is_accepted(change, place, tmp_path):
    numbers = DOCUMENTED.partition("<Matrix>")[2].partition("</Matrix>")[0].split()
    edited = list(numbers)
    edited[place] = repr(float(numbers[place]) * (1 + change))
    text = DOCUMENTED.replace(DOCUMENTED.partition("<Matrix>")[2], "\n" + " ".join(edited) + "\n")
    text += "</Matrix></Projection></RTKThreeDCircularGeometry>"
    (tmp_path / "rig.xml").write_text(text)
    assert len(rtk_xml.read(tmp_path / "rig.xml", DETECTOR)) == 1


EDITED = {
    "gantry angle by a degree": ("271.847274780273", "272.847274780273"),
    "gantry angle by 0.01 degrees": ("271.847274780273", "271.857274780273"),
    "offset along u by 0.1 mm": ("-117.056503295898<", "-116.956503295898<"),
    "offset along v with the other sign": ("-1.01195001602173<", "1.01195001602173<"),
    "distance of the source": (">1000<", ">1001<"),
    "distance of the detector": (">1536<", ">1537<"),
    "an in-plane angle": ("<Matrix>", "<InPlaneAngle>0.1</InPlaneAngle><Matrix>"),
    "an out-of-plane angle": ("<Matrix>", "<OutOfPlaneAngle>0.1</OutOfPlaneAngle><Matrix>"),
    "an offset of the source": ("<Matrix>", "<SourceOffsetX>0.5</SourceOffsetX><Matrix>"),
    "an element of the matrix": ("-1531.42837748039", "-1531.52837748039"),
    "the matrix of a view before": (
        "</Projection>\n",
        "</Projection><Projection><GantryAngle>3</GantryAngle></Projection>\n",
    ),
}


@pytest.mark.parametrize("edit", EDITED)
def test_a_matrix_that_contradicts_its_projection_is_refused(edit, tmp_path):
    """RTK's XML, one of whose distances, angles or offsets was edited without the matrix, is
    refused, as RTK refuses it.
    """
    old, new = EDITED[edit]
    assert old in DOCUMENTED
    (tmp_path / "rig.xml").write_text(DOCUMENTED.replace(old, new))
    with pytest.raises(Refused, match="expected the Matrix of projection . to be that of its"):
        rtk_xml.read(tmp_path / "rig.xml", DETECTOR)


@pytest.mark.parametrize("matrix", ["1 2 3", "1 " * 11 + "x", ""])
def test_a_matrix_of_no_twelve_numbers_is_refused(matrix, tmp_path):
    """RTK's XML with a matrix that is cut short, or no numbers, is refused."""
    head, _, rest = DOCUMENTED.partition("<Matrix>")
    text = f"{head}<Matrix>{matrix}</Matrix>{rest.partition('</Matrix>')[2]}"
    (tmp_path / "rig.xml").write_text(text)
    with pytest.raises(Refused, match="12 numbers for Matrix|finite number for Matrix"):
        rtk_xml.read(tmp_path / "rig.xml", DETECTOR)


@pytest.mark.parametrize(
    ("entry", "good", "bad"), [("n_proj", 2, 3), ("sDetector", [12, 27], [12, 28])]
)
def test_entries_that_repeat_others_are_compared(entry, good, bad, tmp_path):
    """TIGRE's number of projections and size of the detector must be those of its other entries."""
    record = {"DSD": 800, "DSO": 400, "nDetector": [6, 9], "dDetector": [2, 3], "angles": [1, 2]}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({**record, entry: good}))
    assert len(tigre.read(path)) == 2
    path.write_text(json.dumps({**record, entry: bad}))
    with pytest.raises(Refused, match=f"expected {entry}"):
        tigre.read(path)


SID, SDD = XML.splitlines()[3:5]
TWICE = "<GantryAngle>10</GantryAngle><GantryAngle>20</GantryAngle>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML.format(f"<Projection>{TWICE}</Projection>"), "one GantryAngle"),
        (
            XML.replace(SID, SID + SID.replace("400", "500")).format(VIEW.format(10)),
            f"one {SID[1:26]}",
        ),
        (XML.format(VIEW.format(10) + SID), "'SourceToIsocenterDistance' behind it"),
        (XML.replace(SID, "").format(VIEW.format(10)), "SourceToIsocenterDistance"),
        (XML.replace(SDD, "").format(VIEW.format(10)), "SourceToDetectorDistance"),
        (XML.format("<Projection></Projection>"), "GantryAngle of projection 0"),
        (XML.format(VIEW.format("1<x>5</x>")), "GantryAngle"),
        (XML.format(VIEW.format(1).replace("Angle>1", 'Angle unit="rad">1')), "attribute 'unit'"),
        (XML.replace('"3"', '"3" unit="cm"').format(VIEW.format(1)), "attribute 'unit'"),
        (XML.format(VIEW.format(1) + "30"), "'30'"),
        (XML.format(VIEW.format(1).replace("<Gan", "30<Gan")), "'30'"),
        (XML.format(VIEW.format(1).replace("</Pro", "30</Pro")), "'30'"),
        (XML.format(VIEW.format(1).replace("Gantry", "gantry")), "GantryAngle"),
        (
            XML.replace("800", "0").format(
                VIEW.format(1).replace("</P", "<SourceOffsetX>5</SourceOffsetX></P")
            ),
            "parallel beams without SourceOffsetX",
        ),
        (XML.replace("800", "0").replace("400", "-4").format(VIEW.format(1)), "from 0"),
    ],
)
def test_xml_that_states_a_value_twice_nowhere_or_in_another_form_is_refused(
    text, message, tmp_path
):
    """Repeated, missing, late, nested and renamed elements, attributes, text beside elements, and
    offsets of the source of parallel beams.
    """
    (tmp_path / "rig.xml").write_text(text)
    with pytest.raises(Refused, match=message):
        rtk_xml.read(tmp_path / "rig.xml", DETECTOR)


def test_parallel_beams_need_no_distance(tmp_path):
    """Their rays are the same for any SourceToIsocenterDistance, also for RTK's default, 0."""
    rigs = []
    for sid in (0, 400):
        (tmp_path / "rig.xml").write_text(
            XML.replace("800", "0").replace("400", str(sid)).format(VIEW.format(30))
        )
        rigs.append(rtk_xml.read(tmp_path / "rig.xml", DETECTOR))
    directions = [(rig.origin - rig.source) for rig in rigs]
    assert all(rig.parallel for rig in rigs)
    assert np.allclose(*[d / d.norm() for d in directions])


@pytest.mark.parametrize("value", ["120.5", "1.79769313486232e+308"])
def test_jaws_of_a_projection_may_be_open(value, tmp_path):
    """RTK writes jaws that are open beside others that are not as the largest double in 15 digits,
    which rounds to infinity. Also tried: a word, which is refused.
    """
    word = "CollimationUInf"
    view = VIEW.format(30).replace("<GantryAngle>", f"<{word}>{value}</{word}><GantryAngle>")
    (tmp_path / "rig.xml").write_text(XML.format(view))
    assert len(rtk_xml.read(tmp_path / "rig.xml", DETECTOR)) == 1
    (tmp_path / "rig.xml").write_text(XML.format(view.replace(value, "open")))
    with pytest.raises(Refused):
        rtk_xml.read(tmp_path / "rig.xml", DETECTOR)


@pytest.mark.parametrize("name", ["DSO", "angles", "mode"])
def test_json_that_states_a_name_twice_is_refused(name, tmp_path):
    """Python's reader keeps the last value in silence."""
    entries = {"mode": "cone", "angles": [0.0], "nDetector": [8, 9], "dDetector": [1, 1]}
    text = json.dumps({**entries, "DSD": 800, "DSO": 400})
    again = json.dumps({name: {"DSO": 500, "angles": [1.0], "mode": "parallel"}[name]})
    (tmp_path / "rig.json").write_text(f"{text[:-1]}, {again[1:]}")
    with pytest.raises(Refused, match=name):
        tigre.read(tmp_path / "rig.json")


PLATE = {"pixels": [4, 6], "pixel_mm": 1.0}
TIGRE = {"DSD": 1500, "DSO": 1000, "nDetector": [4, 6], "dDetector": [1, 1], "angles": [0, 1, 2]}


@pytest.mark.parametrize("mode", ["parallel", "PARALLEL", " Parallel", "cone", "CONE"])
def test_modes_of_tigre_count_regardless_of_case(mode, tmp_path):
    """As the check of its entries accepts them."""
    (tmp_path / "rig.json").write_text(json.dumps({**TIGRE, "mode": mode}))
    assert tigre.read(tmp_path / "rig.json").parallel == ("par" in mode.lower())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"angles": [0, 5, 10, 15]}, "angles up to 15 were taken for radians"),
        ({"rotDetector": [0, 1.0, 0]}, "rotDetector up to 1 were taken for radians"),
        ({"rotDetector": [0, 0, 90]}, "rotDetector in radians, got 90"),
        ({"angles": [0.5] * 4}, "views that differ, got one camera for all 4"),
    ],
)
def test_degrees_and_views_of_one_place_in_a_file_of_tigre(changed, message, tmp_path):
    """Refused where they must be wrong, else warned of; not a turn, nor a quarter turn."""
    path = tmp_path / "rig.json"
    usual = {"angles": RADIANS, "rotDetector": [math.pi / 2, 0.05, -0.05]}
    path.write_text(json.dumps(TIGRE | usual))
    with warnings.catch_warnings(action="error"):
        tigre.read(path)
    path.write_text(json.dumps(TIGRE | changed))
    warned = "taken" in message
    with pytest.warns(match=message) if warned else pytest.raises(Refused, match=message):
        tigre.read(path)


#: Angles of TIGRE in radians, and degrees that are as small.
TURN = np.arange(100) / 99 * 2 * math.pi
RADIAN_ANGLES = {
    "a turn": TURN,
    "half a turn back from 1": 1 - TURN / 2,
    "an open turn": TURN[:-1],
    "three turns": 3 * TURN,
    "a short scan": TURN * 200 / 360,
    "25 degrees to each side": np.radians(np.arange(-25, 26)),
    "half degrees in single precision": np.radians(np.arange(0, 200, 0.5)).astype("f4"),
    "pi of two decimals": np.arange(100) / 99 * 3.14,
    "four decimals": TURN.round(4),
    "the golden angle": np.arange(50) * math.pi * (3 - 5**0.5) % (2 * math.pi),
    "in any order": np.radians(np.random.default_rng(0).permutation(360)),
    "few": np.arange(4) / 2,
}
DEGREE_ANGLES = {
    "5 degrees to each side": np.arange(30) / 29 * 10 - 5,
    "steps of 0.1": np.arange(-30, 30) / 10,
    "an open range": np.arange(100) / 20,
    "more than two pi": np.arange(21.0),
    "single precision": (np.arange(51) / 10 - 2.5).astype("f4"),
    "in any order": np.random.default_rng(0).permutation(300)[:40] / 50,
}


@pytest.mark.parametrize("case", RADIAN_ANGLES)
def test_radians_of_tigre_are_read_as_they_are(case, tmp_path):
    """As its demos and converted degrees have them, without a warning within a turn."""
    path, angles = tmp_path / "rig.json", RADIAN_ANGLES[case].tolist()
    path.write_text(json.dumps(TIGRE | {"angles": angles}))
    rig = circular(len(angles), 1000.0, 1500.0, PLATE, angles=np.degrees(angles).tolist())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if max(angles) - min(angles) > 7 else "error")
        assert same(tigre.read(path), rig, 1e-9)
        assert same(tigre.read(path, degrees=False), rig, 1e-9)


@pytest.mark.parametrize("case", DEGREE_ANGLES)
def test_angles_of_tigre_that_look_like_degrees_are_asked_about(case, tmp_path):
    """Ends, or all values, of two decimals at most, which radians have neither as they are nor in
    degrees, as the first or the third of Euler's angles, both about the axis. Measured degrees of
    more decimals are not told from radians.
    """
    path, angles = tmp_path / "rig.json", DEGREE_ANGLES[case].tolist()
    path.write_text(json.dumps(TIGRE | {"angles": angles, "rotDetector": [0, 0, 0.5]}))
    question = r"look like degrees; say degrees=true \(camera\.degrees\)"
    with pytest.raises(Refused, match=question):
        tigre.read(path)
    third = path.with_name("third.json")
    third.write_text(json.dumps(TIGRE | {"angles": [[0, 0, angle] for angle in angles]}))
    with pytest.raises(Refused, match=question):
        tigre.read(third)
    found = [tigre.read(path, degrees=value) for value in (True, False)]
    record = TIGRE | {
        "angles": np.radians(angles).tolist(),
        "rotDetector": [0, 0, math.radians(0.5)],
    }
    path.write_text(json.dumps(record))
    assert same(found[0], tigre.read(path, degrees=False), 1e-9)
    assert not same(*found, 1e-3)


@pytest.mark.parametrize(
    ("wrong", "got"),
    [
        ({"parallel": True}, "parallel3d_vec, mm .RAS., 6 rows"),
        ({"pixels": [9, 6]}, "cone_vec, mm .RAS., 9 rows, 6 columns"),
        ({"unit_mm": 10.0}, "10 mm .RAS."),
        ({"world": "LPS"}, "mm .LPS."),
    ],
)
def test_options_that_contradict_the_first_line_of_astra_s_vectors_are_refused(
    wrong, got, tmp_path
):
    """As `write` wrote it."""
    path, options = tmp_path / "rig.txt", {"pixels": [6, 9]}
    astra.write(circular(3, sid=400, sdd=800, detector=DETECTOR), path)
    astra.read(path, **options)
    with pytest.raises(Refused, match=f"first line .* got # ASTRA .*{got}"):
        astra.read(path, **options | wrong)


def test_unit_vectors_as_sources_of_astra_s_cone_beams_are_warned_of(tmp_path):
    """They are the rays of parallel beams."""
    rays = "1 0 0 -50 0 0 0 1 0 0 0 1", "0 1 0 0 -50 0 -1 0 0 0 0 1"
    (tmp_path / "rig.txt").write_text("\n".join(rays))
    with pytest.warns(UserWarning, match="set parallel=true"):
        astra.read(tmp_path / "rig.txt", [6, 9])
