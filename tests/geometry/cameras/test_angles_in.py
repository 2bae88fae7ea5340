"""Angles in files: every form gives the same rig; radians and other columns are refused."""

import re
import warnings

import numpy as np
import pytest
import torch

from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import EXPOSURES
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.formats.common import angles_in, numbers_in
from mvrecon.geometry.cameras.rigs import circular, parallel

ANGLES = [-10.0, 0.5, 12.25, 90.0, 181.0, 200.0, 270.5, 1e1]
PLATE = {"pixels": [1, 8], "pixel_mm": 1.0}
COLUMN = "\n".join(map(str, ANGLES))
FORMS = {
    "a.txt": f"# degrees\n\n{COLUMN}\n",
    "b.txt": COLUMN.replace("\n", ",\r\n"),
    "c.csv": "frame,Angle (deg),time\n" + "\n".join(f"{k},{a},9" for k, a in enumerate(ANGLES)),
    "d.csv:turn": "turn;theta\n" + "\n".join(f"{a};0" for a in ANGLES),
    "e.csv": f'"theta"\n{COLUMN}',
    "i.csv": ",angle\n" + "\n".join(f"{k},{a}" for k, a in enumerate(ANGLES)),  # of pandas
    "j.tsv": "\tangle\n" + "\n".join(f"{k}\t{a}" for k, a in enumerate(ANGLES)),
    "k.csv": "time,angle\n" + "\n".join(f"10:00 {k},{a}" for k, a in enumerate(ANGLES)),
    "l.txt": f"Angle (deg)\n{COLUMN}",
    "m.csv": "Bild;Angle (°)\n" + "\n".join(f"{k};{a}" for k, a in enumerate(ANGLES)),
    "n.csv": f"Angle (°)\n{COLUMN}",  # in Latin-1, as programs of Windows write it
    "o.txt": f"# degrees, from radians; by Conrad, at the radius 3\n{COLUMN}  # rad\n",
    **{
        f"comment {k}.txt": f"# {words}\n{COLUMN}\n"
        for k, words in enumerate(
            (
                *("gradient", "3 turns", "in 3 turns", "(2 turns)", "two turns", "turns: 3"),
                *("grad student", "by a grad student", "rad. dose", "dose / rad. unit", "rev 2"),
                *("Rev. B", "(rev B)", "version: rev 3", "step of 0.5 mrad", "scan (0.2 rad wide)"),
                *("in deg, not in radians", "rotation of 3 revolutions", "Paragon stage"),
            )
        )
    },
    "p.csv": f"Radiography: angle\n{COLUMN}",
    "f.tsv": "view\trotation\n" + "\n".join(f"{k}\t{a}" for k, a in enumerate(ANGLES)),
}


def fan(angles):
    return circular(8, 200.0, 400.0, PLATE, angles=angles)


@pytest.mark.parametrize("rig", [fan, lambda angles: parallel(8, PLATE, angles=angles)])
@pytest.mark.parametrize("name", [*FORMS, "g.npy", "h.npy"])
def test_angles_in_a_file_are_those_of_the_rig(name, rig, tmp_path):
    path = tmp_path / name.partition(":")[0]
    if path.suffix == ".npy":
        values = np.array(ANGLES, "f4" if name < "h" else "f8")
        np.save(path, values[:, None] if name < "h" else values)
    else:
        path.write_bytes(FORMS[name].encode("latin-1" if name == "n.csv" else "utf-8"))
    assert torch.equal(rig(tmp_path / name).origin, rig(ANGLES).origin)


REFUSED = {
    "radians": ("\n".join(str(a) for a in np.linspace(0, 3.1, 8)), "look like radians"),
    "a column of radians": ("theta_rad\n" + COLUMN, "expected degrees, got 'theta_rad'"),
    "radians in a name of two words": ("Angle (rad)\n" + COLUMN, "expected degrees"),
    "three turns in radians by numpy.savetxt": ("# theta (rad)\n0\n18.85\n", "multiply by 57.29"),
    "a comment below another": ("# of July\n# theta [rad]\n0\n3\n", "'of July theta .rad.'"),
    "radians, not degrees": ("# in radians, not in degrees\n0\n18.85\n", "multiply by 57.29"),
    "radians beside a step": ("# step 0.5 deg; unit: rad\n0\n18.85\n", "multiply by 57.29"),
    "radians with a formula": ("# theta in rad (deg * pi / 180)\n0\n18.85\n", "by 57.29"),
    "radians alone": ("# radians, clockwise\n0\n18.85\n", "multiply by 57.29"),
    "turns alone": ("# turns\n0\n0.5\n", "multiply by 360"),
    "gon behind in": ("# Winkel in gon der Anlage\n0\n300\n", "multiply by 0.9"),
    "milliradians": ("theta_mrad\n0\n300\n", "multiply by 0.0572"),
    "arc minutes": ("angle (arcmin)\n0\n300\n", "multiply by 0.01666667"),
    "arc seconds": ("angle / arc sec\n0\n300\n", "multiply by 0.0002777"),
    "gon": ("i,Winkel angle (gon)\n0,0\n1,100\n", "multiply by 0.9"),
    "turns": ("rotation (turns)\n0\n0.5\n", "multiply by 360"),
    "comma decimals": ("0,5\n1,0\n", "expected one column"),
    "comma decimals under a name": ("angle\n0,5\n1,0\n", "got '0,5'"),
    "comma decimals in a column": ("angle;i\n0,5;1\n1,0;1\n", "got '0,5'"),
    "comma decimals between commas": ("angle,i\n0,5,1\n1,0,1\n", "are its decimals not points"),
    "one angle": ("0\n0\n0\n", "expected angles that differ"),
    "two columns": ("1 2\n3 4\n", "expected one column of angles"),
    "two names": ("angle,theta\n1,2\n", "got the columns angle, theta"),
    "another name": ("x,y\n1,2\n", "got the columns x, y"),
    "words": ("1\n2\nthree\n", "expected a finite number"),
    "NaN": ("1\nnan\n", "expected a finite number"),
    "a short line": ("x,angle\n1,2\n3\n", "as many numbers in every line"),
    "nothing": ("# angle\n", "expected one column"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_file_without_one_column_of_degrees_is_refused(fault, tmp_path):
    text, message = REFUSED[fault]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(Refused, match=message):
        angles_in(tmp_path / "a.csv")


def test_small_arcs_and_numbers_of_angles(tmp_path):
    """Small angles need `small_arc`; a rig has as many angles as views."""
    np.save(tmp_path / "a.npy", np.linspace(0, 3, 8))
    rig = parallel(8, PLATE, angles=tmp_path / "a.npy", small_arc=True)
    assert torch.equal(rig.origin, parallel(8, PLATE, angles=np.linspace(0, 3, 8).tolist()).origin)
    with pytest.raises(Refused, match="expected an angle of each of 7 views, got 8"):
        parallel(7, PLATE, angles=tmp_path / "a.npy", small_arc=True)


ORDERS = {
    "names sorted as text": ("file,angle", [f"v_{k}.tif" for k in sorted(range(12), key=str)]),
    "from the last view": ("view,angle", [*range(11, -1, -1)]),
    "numbers with zeros": ("i;angle", [f"{k:04}" for k in (3, 0, 1, 2)]),
}


@pytest.mark.parametrize("case", ORDERS)
def test_lines_in_another_order_than_they_state_are_refused(case, tmp_path):
    """Also exposures, which are read alike. A first column that does not count is no order: names
    without numbers, times, and angles.
    """
    head, texts = ORDERS[case]
    mark = "," if "," in head else ";"
    lines = [f"{text}{mark}{10 * k}" for k, text in enumerate(texts)]
    (tmp_path / "a.csv").write_text("\n".join([head, *lines]))
    with pytest.raises(Refused, match="lines in the order of the views, got"):
        angles_in(tmp_path / "a.csv")
    with pytest.raises(Refused, match="lines in the order of the views, got"):
        numbers_in(tmp_path / "a.csv", EXPOSURES._replace(names=re.compile("angle")))


@pytest.mark.parametrize(
    ("head", "first"),
    [
        ("time,theta", ["9.5", "7.25", "8.5"]),
        ("counts,theta", ["512", "480", "530"]),
        ("name,theta", ["a", "c", "b"]),
        ("scan,theta", ["bone2_a", "bone2_c", "bone2_b"]),
        ("exposure,theta", ["1", "2", "1"]),
        ("file,theta", ["s_0009.tif", "s_0010.tif", "s_0011.tif"]),
        ("target angle,theta", ["0", "2", "1"]),
    ],
)
def test_a_first_column_that_counts_no_views_is_no_order(head, first, tmp_path):
    (tmp_path / "a.csv").write_text("\n".join([head, *(f"{x},{k}" for k, x in enumerate(first))]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        numbers = numbers_in(
            tmp_path / "a.csv", common.ANGLES._replace(names=re.compile("^theta"))
        )[1]
    assert numbers == [0.0, 1.0, 2.0]


STATED = {
    "theta\n0\n9": [],
    "# counter-clockwise, in degrees\n0\n9": [],
    "# scan of a bone, anticlockwise; ccw\n0\n9": [],
    "view,angle,exposure,time\n0,0,1,1\n1,9,2,3": [],
    "# clockwise\n0\n9": ["clockwise"],
    "angle_cw\n0\n9": ["angle_cw"],
    "view,angle,tilt,offset_u\n0,0,1,1\n1,9,2,3": ["tilt", "offset_u"],
    "angle,x shift\n0,0\n9,2": ["x shift"],
}


@pytest.mark.parametrize("text", STATED)
def test_what_a_table_of_angles_states_beside_them_is_named(text, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert angles_in(tmp_path / "a.csv") == [0.0, 9.0]
    named = [str(one.message).split("does not know: ")[1].split("; if")[0] for one in caught]
    assert named == [", ".join(STATED[text])] * bool(STATED[text])


def test_a_second_array_behind_the_angles_is_refused(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        for part in (ANGLES[:4], ANGLES[4:]):
            np.save(file, np.array(part))
    with pytest.raises(Refused, match="expected one array of"):
        angles_in(tmp_path / "a.npy")


TABLES = {
    "view,exposure": [],
    "view,exposure,temperature": [],
    "view,exposure,current_uA": ["current_uA"],
    "view,exposure,frames": ["frames"],
    "view,exposure,attenuator_transmission": ["attenuator_transmission"],
    "view,1/exposure": ["1/exposure"],
    "view,inverse_exposure,gain": ["inverse_exposure", "gain"],
    "view,log2 exposure": ["log2 exposure"],
}


@pytest.mark.parametrize("head", TABLES)
def test_other_columns_that_may_be_factors_of_exposures_are_named(head, tmp_path):
    """And names of the column by which its numbers are no exposures."""
    row = ",".join(["1.5"] * head.count(","))
    (tmp_path / "a.csv").write_text("\n".join([head, *(f"{k},{row}" for k in range(4))]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _, numbers = numbers_in(tmp_path / "a.csv", EXPOSURES)
    assert numbers == [1.5] * 4
    found = [str(one.message).split("know: ")[1].split("; if")[0] for one in caught]
    assert sorted(", ".join(found).split(", ")) == sorted(TABLES[head] or [""])
