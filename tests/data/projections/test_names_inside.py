"""Options of views are files, or else names of what the scan's file contains, with or without a
slash, as typed in any folder: on a command line, in a scan.yaml and in Python.
"""

from contextlib import chdir

import h5py
import numpy as np
import pytest
import torch
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from mvrecon.apps.config import absolute_paths
from mvrecon.apps.scan_file import NAME, expanded, save
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections
from mvrecon.data.projections.views import Measured, MeasuredViews
from tests.data.projections.conftest import VIEWS, grey, images
from tests.data.projections.test_nexus import ANGLES, DARK, FLAT, KEYS, frames, integrals

#: Exposures of the views relative to the flat field's.
EXPOSURES = np.linspace(0.5, 2, VIEWS)
NAMED = {"dataset": "raw/frames", "flat": "raw/open", "dark": "shut", "angles": "turn"}
KEYED = {"dataset": "raw/all", "image_key": "raw/keys", "angles": "turn"}


@pytest.fixture
def scan(tmp_path):
    """An HDF5 file of a layout of its own."""
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["raw/frames"], file["raw/open"] = grey(), np.full(grey().shape[1:], FLAT, "u2")
        file["shut"], file["turn"] = np.full(grey().shape[1:], DARK, "u2"), ANGLES
        file["raw/all"], file["raw/keys"] = frames(), KEYS
        file["light"], file["group/inner"] = EXPOSURES, 1
    return tmp_path / "scan.h5"


def typed(folder, views):
    """The views of options as typed on a command line in a folder; its task may run elsewhere."""
    with chdir(folder):
        settings = absolute_paths({"views": views}, ReconstructSettings)
    return MeasuredViews(Measured(**settings["views"]))


def told(folder, views):
    """The views of options in a scan.yaml, of which a copy is written elsewhere."""
    copy = folder / "copy"
    copy.mkdir(exist_ok=True)
    (folder / NAME).write_text(yaml.safe_dump({"views": views}))
    save(copy / NAME, {"views": options_in(folder)})
    return typed(copy, options_in(copy))


def options_in(folder):
    """The options of views that the scan.yaml of a folder stands for, as Hydra reads them."""
    words = OverridesParser.create().parse_overrides(expanded([f"scan={folder}"]))
    return {word.key_or_group.removeprefix("views."): word.value() for word in words}


@pytest.mark.parametrize("way", [typed, told])
@pytest.mark.parametrize("slash", ["", "/"])
@pytest.mark.parametrize("names", [NAMED, KEYED], ids=["named", "keyed"])
def test_names_inside_the_scans_file_need_no_slash(names, slash, way, scan):
    """Also tried: names with a dot, which is no ending here, and of the file's own folder."""
    views = way(scan.parent, {"path": "scan.h5", **{k: slash + n for k, n in names.items()}})
    expected = torch.from_numpy(integrals()).float()
    assert torch.allclose(views.whole().views, expected, atol=2e-6)
    assert np.allclose(views.stack.rig["angles"], ANGLES)


@pytest.mark.parametrize("way", [typed, told])
@pytest.mark.parametrize("name", ["light", "/light", "scan.h5:/light", "light.npy", "light.csv"])
def test_exposures_are_named_as_all_others(name, way, scan):
    np.save(scan.with_name("light.npy"), EXPOSURES)
    rows = "\n".join(f"{k},{x!r}" for k, x in enumerate(EXPOSURES.tolist()))
    scan.with_name("light.csv").write_text(f"view,exposure\n{rows}\n")
    views = way(scan.parent, {"path": "scan.h5", **NAMED, "exposure": name})
    assert torch.allclose(views.exposure, torch.from_numpy(EXPOSURES).float())


@pytest.mark.parametrize("way", [typed, told])
def test_a_file_comes_before_a_data_set_of_its_name(way, scan):
    """Unless the name has a slash; a group of this name is no data set."""
    for name in ("shut", "group"):
        images(scan.with_name(name), np.full((2, *grey().shape[1:]), DARK + 9, "u2"))
    for name, value in {"shut": DARK + 9, "/shut": DARK, "group": DARK + 9}.items():
        dark = way(scan.parent, {"path": "scan.h5", **NAMED, "dark": name}).fields.dark
        assert (dark == value).all()


def python(folder, views):
    """The views of options in Python, in a folder."""
    with chdir(folder):
        return MeasuredViews(Measured(**{**views, "path": folder / views["path"]}))


@pytest.mark.parametrize("way", [typed, told, python])
def test_a_folder_of_the_name_of_a_data_set_is_none_of_what_needs_a_file(way, scan):
    """Whatever is in it; a folder of a field's name is its images. Also tried: a description beside
    such folders that is written elsewhere, links to folders.
    """
    for name in ("raw/all", "raw/keys", "turn", "light", "none"):
        (scan.parent / name).mkdir(parents=True)
        images(scan.parent / name, grey())
    views = way(scan.parent, {"path": "scan.h5", **KEYED, "exposure": "light"})
    expected = integrals() + np.log(EXPOSURES)[:, None, None]
    assert torch.allclose(views.whole().views, torch.from_numpy(expected).float(), atol=2e-6)
    assert np.allclose(views.stack.rig["angles"], ANGLES)
    with pytest.raises(Refused, match="has no data set none, nor is there a file none"):
        typed(scan.parent, {"path": "scan.h5", **KEYED, "angles": "none"})


@pytest.mark.parametrize("way", [typed, told])
@pytest.mark.parametrize("name", ["1e1", "null", "2020", "true", "007", "1.5"])
def test_data_sets_may_be_called_as_numbers_are(name, way, scan):
    with h5py.File(scan, "a") as file:
        file[name], file[f"of/{name}"] = ANGLES, KEYS
    views = way(
        scan.parent,
        {"path": "scan.h5", "dataset": "raw/all", "angles": name, "image_key": f"of/{name}"},
    )
    assert np.allclose(views.stack.rig["angles"], ANGLES)


@pytest.mark.parametrize("path", ["scan.h5", "scan.h5:/raw/frames"])
def test_files_where_a_command_runs_are_not_those_of_a_scan(path, scan, monkeypatch):
    """A scan.yaml means the same in every folder, also in one with files of its names, and where a
    calibration writes it anew beside such files.
    """
    here = scan.with_name("here")
    for name in ("raw/open", "shut", "copy/raw/open", "copy/shut"):
        (here / name).mkdir(parents=True)
        images(here / name, np.full((2, *grey().shape[1:]), 9, "u2"))
    for name in ("turn", "light", "copy/turn"):
        (here / name).write_text("1\n" * VIEWS)
    options = {**NAMED, "path": path, "exposure": "light"}
    options = {k: v for k, v in options.items() if k != "dataset" or path == "scan.h5"}
    scan.with_name(NAME).write_text(yaml.safe_dump({"views": options}))
    monkeypatch.chdir(here)
    for folder in (scan.parent, here / "copy"):
        settings = options_in(folder)
        views = typed(here, settings)
        expected = integrals() + np.log(EXPOSURES)[:, None, None]
        assert torch.allclose(views.whole().views, torch.from_numpy(expected).float(), atol=2e-6)
        assert np.allclose(views.stack.rig["angles"], ANGLES)
        save(here / "copy" / NAME, {"views": settings})


def test_a_missing_file_of_a_scan_is_not_taken_from_where_a_command_runs(tmp_path, monkeypatch):
    for folder, name in (("scan", "views"), ("here", "flat")):
        (tmp_path / folder).mkdir()
        images(tmp_path / folder / name, grey())
    (tmp_path / "scan" / NAME).write_text("views: {path: views, flat: flat}")
    with h5py.File(tmp_path / "here" / "b.h5", "w") as file:
        file["flat"] = grey()[0]
    monkeypatch.chdir(tmp_path / "here")
    for path, flat in (("views", "flat"), ("scan.h5", "b.h5:/flat"), ("scan.h5", "./flat")):
        (tmp_path / "scan" / NAME).write_text(f"views: {{path: {path}, flat: '{flat}'}}")
        assert f"views.flat={tmp_path / 'scan' / flat}" in expanded([f"scan={tmp_path / 'scan'}"])


def test_a_file_that_the_scan_does_not_contain_is_read(scan):
    """Of images, by an absolute path, one that begins at home, and in Python."""
    folder = images(scan.with_name("darks"), np.full((2, *grey().shape[1:]), DARK, "u2"))
    for dark in ("darks", str(folder), "./darks", f"../{scan.parent.name}/darks"):
        views = typed(scan.parent, {"path": "scan.h5", **NAMED, "dark": dark})
        assert (views.fields.dark == DARK).all()
    options = {**NAMED, "dark": folder}
    assert (MeasuredViews(Measured(path=scan, **options)).fields.dark == DARK).all()


@pytest.mark.parametrize("key", ["dataset", "angles", "image_key", "flat", "dark", "exposure"])
def test_what_is_neither_is_refused_by_both_places(key, scan):
    """With what the scan's file contains."""
    options = {"path": "scan.h5", **NAMED, key: "raw/none"}
    with pytest.raises((Refused, FileNotFoundError)) as caught:
        typed(scan.parent, options).fields  # noqa: B018
    message = str(caught.value)
    assert "scan.h5" in message and "raw/none" in message and "/raw/frames (12, 6, 8)" in message
    assert "no such file" in message or "nor is there a file" in message


@pytest.mark.parametrize("key", ["dataset", "angles", "image_key"])
def test_a_file_without_a_name_inside_says_what_is_missing(key, scan):
    with h5py.File(scan.with_name("b.h5"), "w") as file:
        file["x"] = ANGLES
    name = "b.h5" if key != "dataset" else str(scan.with_name("b.h5"))
    with pytest.raises(Refused, match=r"b.h5 is a file: .*b.h5:/<name>"):
        typed(scan.parent, {"path": "scan.h5", **NAMED, key: name})


def test_names_are_those_of_the_scans_file_whose_frames_are_in_another(scan):
    """A file of links, as beamlines write, has flats and exposures of its own."""
    with h5py.File(scan.with_name("links.nxs"), "w") as file:
        file["frames"] = h5py.ExternalLink("scan.h5", "/raw/frames")
        file["white"], file["turn"] = np.full(grey().shape[1:], FLAT, "u2"), ANGLES
        file["dose"] = EXPOSURES
        file["black"] = h5py.ExternalLink("scan.h5", "/shut")
    options = {"dataset": "frames", "angles": "turn", "flat": "white", "dark": "black"}
    views = typed(scan.parent, {"path": "links.nxs", **options, "exposure": "dose"})
    assert (views.fields.dark == DARK).all()
    assert torch.allclose(views.exposure, torch.from_numpy(EXPOSURES).float())


def test_options_of_other_formats_are_files_alone(tmp_path):
    images(tmp_path / "scan", grey())
    images(tmp_path / "darks", np.full((2, *grey().shape[1:]), DARK, "u2"))
    views = typed(tmp_path, {"path": "scan", "flat": FLAT, "dark": "darks"})
    assert (views.fields.dark == DARK).all()
    with pytest.raises(FileNotFoundError, match="none: no such file or folder"):
        typed(tmp_path, {"path": "scan", "flat": float(FLAT), "dark": "none"})
    assert open_projections(tmp_path / "scan").scan is None
