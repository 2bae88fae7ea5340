"""An option has one default, that of its signature: no file of settings repeats or changes it.

Walks all files of conf and of the plugins' conf. A file of the name of its part (`camera=circular`)
sets what has no default; one of another name is a variant (`circular_small`), and sets other values
than the defaults. Settings that are no parts (views, data, acquisition), whose files list all
options for `--help`, list the defaults.
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from mvrecon.apps.config import compose, trusted_folders
from mvrecon.apps.reconstruct import rig_of_scan
from mvrecon.apps.settings import SECTIONS
from mvrecon.apps.stated_rig import completed
from mvrecon.core.parts import CAMERAS, REGISTRIES, describe, describe_section
from mvrecon.core.signatures import REQUIRED, Option
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.geometry.cameras.rigs import Detector, circular

FILES = [file for folder in trusted_folders() for file in sorted(Path(folder).rglob("*.yaml"))]
#: Choices of settings that are no parts which an app makes: these list the defaults.
LISTING = {"views/measured", "data/default", "acquisition/ideal"}
#: Options that differ in the file of their part, which says why.
STATED = {
    ("network/unet3d", "norm"),
    ("network/unet3d", "padding"),
    ("trainer/default", "strategy"),
}
UNKNOWN = object()
PIXEL = "camera.detector.pixel_mm=1"


def default_of(option: Option) -> Any:
    """The default as a plain value; UNKNOWN if there is none."""
    value = option.default
    return (
        list(value) if isinstance(value, tuple) else UNKNOWN if value in (..., REQUIRED) else value
    )


def plain(file: Path) -> dict[str, Any]:
    return OmegaConf.to_container(OmegaConf.load(file), resolve=False) or {}  # type: ignore[return-value]


def inherited(file: Path) -> dict[str, Any]:
    """The settings of a file over those of its group that its defaults list names."""
    own = plain(file)
    names = [name for name in own.get("defaults", ()) if isinstance(name, str) and name != "_self_"]
    for name in reversed(names):
        own = {**inherited(file.with_name(f"{name}.yaml")), **own}
    return own


def wrong(file: Path, references: set[str]) -> Iterator[str]:
    """The options of a file that repeat or change a default, in words."""
    group, place = file.parent.name, f"{file.parent.name}/{file.stem}"
    if group not in REGISTRIES and group not in SECTIONS:
        return
    own, part = plain(file), inherited(file).get("name", "")
    found = describe(group, part) if group in REGISTRIES else None
    options = (found or describe_section(group, SECTIONS[group])).options
    for key, value in own.items():
        default = default_of(options.get(key, Option()))
        has_default = key in options and options[key].default not in (..., REQUIRED)
        referred = f"{group}.{key}" in references  # must be here for the reference to resolve
        if key in ("name", "defaults") or not has_default or "${" in str(value):
            continue
        if place in LISTING or referred:
            if value != default:
                yield f"{place}: {key} is {value}, and by default {options[key].default}"
        elif file.stem == part and (place, key) not in STATED:
            yield f"{place}: {key} has a default already, {options[key].default}"
        elif value == default and (place, key) not in STATED:
            yield f"{place}: {key} repeats its default"


def test_no_file_repeats_or_changes_a_default():
    """Of any group, part and plugin; `camera=circular` had an arc of 180 degrees, and `data` two
    cases in a batch, where the signatures had 360 and one.
    """
    texts = "\n".join(file.read_text() for file in FILES)
    references = set(re.findall(r"\$\{(\w+\.\w+)\}", texts))
    assert len(FILES) >= 90
    assert [words for file in FILES for words in wrong(file, references)] == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: circular\nn_views: 8\narc_degrees: 180.0\n", "arc_degrees has a default already"),
        ("name: circular\nstart_degrees: 0.0\n", "start_degrees has a default already"),
    ],
)
def test_such_a_file_is_found(tmp_path: Path, text: str, words: str):
    (tmp_path / "camera").mkdir()
    file = tmp_path / "camera" / "circular.yaml"
    file.write_text(text)
    assert [words in found for found in wrong(file, set())] == [True]
    variant = file.rename(file.with_name("other.yaml"))
    assert len(list(wrong(variant, set()))) == ("start" in text)  # which repeats it


def test_detectors_in_files_have_the_defaults_of_a_detector():
    detectors = [plain(f).get("detector") for f in FILES if f.parent.name == "camera"]
    offsets = [d.get("offset_mm") for d in detectors if isinstance(d, Mapping)]
    assert len(offsets) > 5
    assert {tuple(offset) for offset in offsets if offset is not None} == {Detector.offset_mm}


@pytest.mark.parametrize("app", ["train", "simulate"])
def test_a_rig_has_one_default(app: str):
    """As composed by an app, in Python and in `mvrecon-list`: a full circle."""
    options = compose("camera=circular", config_name=app)["camera"]
    rig = CAMERAS.from_config(options)
    assert "arc_degrees" not in options
    assert describe("camera", "circular").options["arc_degrees"].default == 360.0
    needed = {key: options[key] for key in ("n_views", "sid", "sdd", "detector")}
    assert rig.source.equal(circular(**needed).source)
    assert (rig.source[0] + rig.source[4]).norm() < 1e-9  # opposite: of eight on a full circle


#: Experiments that were trained, and whose figures are documented, on half a circle of views.
HALF = {
    **{"quickstart": 8, "smoke": 4, "wrong_cameras": 8, "open_kbp": 8, "open_kbp_64": 8},
    **{"open_kbp_128": 8, "open_kbp_faults": 8, "open_kbp_faults_64": 8, "open_kbp_rig_errors": 8},
}


@pytest.mark.parametrize("name", HALF)
def test_an_experiment_keeps_its_half_circle(name: str):
    rig = CAMERAS.from_config(compose(f"experiment={name}")["camera"])
    assert len(rig) == HALF[name]
    angles = [180 * k / len(rig) for k in range(len(rig))]
    places = rig.source / rig.source.norm(dim=1, keepdim=True)
    assert places[:, 0].tolist() == pytest.approx(
        [math.cos(math.radians(a)) for a in angles], abs=1e-9
    )
    assert (places[1:, 1] > 0).all()


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        (
            ["camera=circular"],
            "camera.sid= camera.sdd= camera.detector.pixel_mm= camera.arc_degrees=",
        ),
        (["camera=arc", "camera.sid=4", "camera.sdd=8", PIXEL], "camera.arc_degrees="),
        (["camera=circular", "camera.sid=4", "camera.sdd=8", PIXEL, "camera.arc_degrees=360"], ""),
        (["camera=circular", "camera.sid=4", "camera.sdd=8", PIXEL, "camera.angles=[1,2]"], ""),
        (["camera=parallel", PIXEL], ""),
    ],
)
def test_a_scanner_s_range_of_angles_is_asked_for(options: list[str], missing: str, tmp_path: Path):
    """Of a cone beam in `mvrecon-reconstruct`, where the default of a simulated rig is a guess;
    parallel beams determine a slice over theirs, 180 degrees.
    """
    camera = compose(*options, "views.path=x", config_name="reconstruct")["camera"]
    np.save(tmp_path / "views.npy", np.ones((2, 3, 4)))
    views = MeasuredViews(Measured(path=tmp_path / "views.npy", kind="integrals"))
    rig = rig_of_scan(camera, options)
    assert rig["n_views"] is None
    if not missing:
        assert completed(rig, {"pixels": (3, 4)}, views)["n_views"] == 2
        return
    with pytest.raises(ValueError, match=f"Expected {missing} of the scanner"):
        completed(rig, {"pixels": (3, 4)}, views)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["camera.angles=[1,2]", "camera.arc_degrees=9"], "camera.angles or camera.arc_degrees"),
        (["camera.angles=a.txt", "camera.start_degrees=9"], "camera.angles or camera.start_d"),
        (["camera.start_degrees=9"], "Expected camera.arc_degrees with camera.start_degrees"),
        (["camera.start_degrees=9", "camera.arc_degrees=90"], ""),
        (["camera.start_degrees=0"], ""),
    ],
)
def test_angles_that_are_set_twice_are_refused(options: list[str], message: str, tmp_path: Path):
    """By a list, a range, and the views' file; a range replaces the file's angles as a whole."""
    options = ["camera=parallel", *options]
    camera = compose(*options, "views.path=x", config_name="reconstruct")["camera"]
    np.save(tmp_path / "views.npy", np.ones((2, 3, 4)))
    views = MeasuredViews(Measured(path=tmp_path / "views.npy", kind="integrals"))
    views.stack.rig = {"name": "parallel", "angles": [3.0, 4.0], "detector": {"pixel_mm": (1, 1)}}
    rig = rig_of_scan(camera, options)
    if message:
        with pytest.raises(ValueError, match=message):
            completed(rig, {"pixels": (3, 4)}, views)
        return
    ranged = "camera.arc_degrees=90" in options
    assert completed(rig, {"pixels": (3, 4)}, views).get("angles") == (None if ranged else [3, 4])


@pytest.mark.parametrize("camera", ["parallel", "circular"])
@pytest.mark.parametrize(("count", "small_arc"), [(12, False), (12, True), (7, False)])
def test_typed_angles_in_radians_are_refused_as_those_of_a_file(camera, count, small_arc, tmp_path):
    """Half a radian apart; fewer than eight, and those that are said to be degrees, are taken."""
    np.save(tmp_path / "views.npy", np.ones((count, 3, 4)))
    views = MeasuredViews(Measured(path=tmp_path / "views.npy", kind="integrals"))
    angles = [k / 2 for k in range(count)]
    rig = {"name": camera, "angles": angles, "small_arc": small_arc}
    if count == 12 and not small_arc:
        with pytest.raises(ValueError, match="camera.angles in degrees, got 12 views within 5.5"):
            completed(rig, {"pixels": (3, 4)}, views)
    else:
        assert completed(rig, {"pixels": (3, 4)}, views)["angles"] == angles
