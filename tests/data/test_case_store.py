"""Cases stored in a folder: generated once for any detector, and never wrong."""

import importlib
import sys
from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import CAMERAS, SCENES
from mvrecon.data.acquisition.acquired import Acquired
from mvrecon.data.acquisition.detector import Acquisition
from mvrecon.data.acquisition.disturbances import Disturbance
from mvrecon.data.dataset import CaseStore
from mvrecon.data.digests import files_in
from mvrecon.data.module import SceneData
from mvrecon.geometry.grid import Grid
from tests.data.conftest import RIG

GRID = Grid.centred((8, 8, 8), 6.0)


@pytest.fixture
def cameras():
    return CAMERAS.from_config(RIG)


def measured(folder, acquisition=None, made_of="ellipsoids"):
    scene = SCENES.build("ellipsoids", value=0.02)
    store = CaseStore(folder, {"scene": made_of}, scene)
    return Acquired(scene, {"name": "drr"}, acquisition, store)


def same(one, other):
    names = ("views", "volume", "inside")
    return one.name == other.name and all(
        torch.equal(getattr(one, name), getattr(other, name)) for name in names
    )


def test_a_stored_case_is_generated_once_and_equals_a_new_one(tmp_path, cameras, monkeypatch):
    plain = Acquired(SCENES.build("ellipsoids", value=0.02), {"name": "drr"})
    expected = plain.sample(1, 5, GRID, cameras)
    assert same(measured(tmp_path).sample(1, 5, GRID, cameras), expected)
    again = measured(tmp_path)
    monkeypatch.setattr(again, "ideal", None)  # must not be called
    assert same(again.sample(1, 5, GRID, cameras), expected)


def check_cached(folder, cameras, acquisition, files):
    """A case equals that without a cache, computed and read back; so many files are kept."""
    scene = SCENES.build("ellipsoids", value=0.02)
    expected = Acquired(scene, {"name": "drr"}, acquisition).sample(0, 0, GRID, cameras)
    for _ in range(2):
        assert same(measured(folder, acquisition).sample(0, 0, GRID, cameras), expected)
    assert len(list(folder.iterdir())) == files


def test_noise_and_gains_are_not_stored_and_detector_shifts_have_a_separate_file(tmp_path, cameras):
    for acquisition, files in (
        (None, 1),
        (Acquisition(photons=1e4), 1),
        (Acquisition(disturbed=Disturbance(gain=0.1)), 1),
        (Acquisition(disturbed=Disturbance(shift_px=1.0)), 2),
    ):
        check_cached(tmp_path, cameras, acquisition, files)


def test_views_of_a_breathing_object_have_a_file_for_each_draw_of_its_phases(tmp_path, cameras):
    """The first case at rest shares that of other acquisitions on the finer grid."""
    for disturbed, files in (
        (None, 1),
        ({"probability": 0.0, "breathing_mm": 3.0}, 1),
        ({"views": 3, "breathing_mm": 3.0}, 2),
        ({"views": 2, "breathing_mm": 3.0}, 3),
        ({"views": 3, "breathing_mm": 2.0}, 4),
    ):
        acquisition = Acquisition.of({"closed_form": False, "disturbed": disturbed})
        check_cached(tmp_path, cameras, acquisition, files)


def test_runs_with_and_without_closed_form_views_share_no_file(volume_file, tmp_path):
    """Each gets the views that it gets without a cache, whichever was first."""
    scenes = dict.fromkeys(("train", "test"), {"name": "hdf5", "path": str(volume_file)})
    sizes = {"train": 1, "val": 1, "test": 1}

    def views(closed_form, **options):
        measurement = {"grid": {"shape": [6, 6, 6], "spacing": 8.0}, "camera": RIG}
        measurement |= {"projector": {"name": "drr"}, "acquisition": {"closed_form": closed_form}}
        data = SceneData(scenes, measurement, sizes, **options)
        data.setup("fit")
        return data.sets["train"].prepare()["views"]

    expected = {closed_form: views(closed_form) for closed_form in (True, False)}
    assert not torch.equal(*expected.values())
    for closed_form in (True, False, True):
        cached = views(closed_form, cache=str(tmp_path / "cases"))
        assert torch.equal(cached, expected[closed_form])


def test_the_file_depends_on_scene_case_series_grid_rig_and_breathing(tmp_path, cameras):
    store, moved = measured(tmp_path).store, replace(cameras, source=cameras.source + 1e-6)
    other = measured(tmp_path, made_of="another").store
    paths = {
        store.path(0, 0, GRID, cameras),
        other.path(0, 0, GRID, cameras),
        store.path(1, 0, GRID, cameras),
        store.path(0, 1, GRID, cameras),
        store.path(0, 0, GRID.refined(2), cameras),
        store.path(0, 0, GRID, moved),
        store.path(0, 0, GRID, cameras, [1.0, 0.0, 0.0]),
        store.path(0, 0, GRID, cameras, [0.0, 1.0, 0.0]),
    }
    assert len(paths) == 8
    assert store.path(0, 0, GRID, cameras, [0.0] * 3) in paths, "of a breathing object at rest"


@pytest.mark.parametrize("how", ["cut short", "one bit", "other sizes", "text"])
def test_a_damaged_stored_case_is_regenerated(tmp_path, cameras, how):
    """A stored case that is damaged or of another size is regenerated."""
    expected = measured(tmp_path).sample(0, 0, GRID, cameras)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    if how == "other sizes":
        measured(tmp_path / "other").sample(0, 0, GRID.refined(2), cameras)
        (other,) = (tmp_path / "other").iterdir()
        path.write_bytes(other.read_bytes())
    else:
        at = whole.index(expected.views.numpy().tobytes()[:64])
        flipped = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
        path.write_bytes(
            {"cut short": whole[:-100], "one bit": flipped, "text": b"views"}.get(how, b"")
        )
    assert same(measured(tmp_path).sample(0, 0, GRID, cameras), expected)
    assert len(path.read_bytes()) == len(whole)


def test_a_run_reuses_stored_cases_and_worker_processes_generate_the_same(
    volume_file, tmp_path, monkeypatch
):
    scenes = dict.fromkeys(("train", "test"), {"name": "hdf5", "path": str(volume_file)})
    measurement = {"grid": {"shape": [6, 6, 6], "spacing": 8.0}, "camera": RIG}
    sizes = {"train": 3, "val": 1, "test": 1}

    def views(**options):
        data = SceneData(scenes, measurement, sizes, **options)
        data.setup("fit")
        return data.sets["train"].prepare()["views"]

    expected, folder = views(), tmp_path / "cases"
    assert torch.equal(views(cache=str(folder), workers=1), expected)
    assert len(list(folder.iterdir())) == 4
    monkeypatch.setattr(Acquired, "ideal", None)  # must not be called
    assert torch.equal(views(cache=str(folder), seed=7), expected), "no case depends on the seed"


def test_cases_of_values_beside_their_header_are_regenerated_when_these_change(tmp_path):
    """A MetaImage .mhd, whose values are in a file of their own."""
    itk = pytest.importorskip("SimpleITK")
    scenes = dict.fromkeys(
        ("train", "test"), {"name": "volumes", "path": str(tmp_path / "ct.mhd"), "crop": "none"}
    )
    measurement = {"grid": {"shape": [6, 6, 6], "spacing": 8.0}, "camera": RIG}
    sizes = {"train": 1, "val": 1, "test": 1}

    def truth(hu):
        values = torch.full((12, 12, 12), -1000.0)
        values[3:9, 3:9, 3:9] = hu
        image = itk.GetImageFromArray(values.numpy())
        image.SetSpacing([4.0] * 3)
        image.SetOrigin([-22.0] * 3)
        itk.WriteImage(image, str(tmp_path / "ct.mhd"))
        cache = str(tmp_path / "cases")
        data = SceneData(scenes, measurement, sizes, overlap=True, cache=cache)
        data.setup("test")
        return data.sets["test"].prepare()["volume"].max().item()

    assert truth(1000.0) > 1.5 * truth(0.0)


#: A plugin's scene, whose value is edited, and the plugin's files by where the value is written.
CLASS = (
    "from mvrecon.core.parts import SCENES\n"
    "from mvrecon.data.scenes.sample import Scene\n"
    "class {base}(Scene):\n"
    "    data_range, unit = 0.02, '1/mm'\n"
    "    def sample(self, *case):\n"
    "        return SCENES.build('ellipsoids', value=VALUE).sample(*case)\n"
)
LATER = "\n@SCENES.register('{name}')\nclass Mine(Base): pass\n"
EDITED = {
    "own module": {
        "{name}.py": "VALUE = {value}\n" + CLASS.format(base="Base") + LATER,
    },
    "another file of its package": {
        "{name}/value.py": "VALUE = {value}\n",
        "{name}/__init__.py": "from {name}.value import VALUE\n"
        + CLASS.format(base="Base")
        + LATER,
    },
    "function that returns a scene of mvrecon": {
        "{name}.py": "from mvrecon.core.parts import SCENES\nVALUE = {value}\n"
        "@SCENES.register('{name}')\n"
        "def mine():\n"
        "    return SCENES.build('ellipsoids', value=VALUE)\n",
    },
    "base class elsewhere": {
        "{name}.py": "from mvrecon.core.parts import SCENES\nfrom {name}_base import Base" + LATER,
        "{name}_base.py": "VALUE = {value}\n" + CLASS.format(base="Base"),
    },
    "module beside": {
        "{name}.py": "from {name}_value import VALUE\n" + CLASS.format(base="Base") + LATER,
        "{name}_value.py": "VALUE = {value}\n",
    },
    "part of a mixture": {
        "{name}.py": "VALUE = {value}\n" + CLASS.format(base="Base") + LATER,
    },
    "table of a package": {
        "{name}/__init__.py": "from importlib.resources import files\n"
        "VALUE = float(files('{name}').joinpath('value.txt').read_text())\n"
        + CLASS.format(base="Base")
        + LATER,
        "{name}/value.txt": "{value}\n",
    },
}


@pytest.mark.parametrize("kind", EDITED)
def test_whatever_an_edited_plugin_is_made_of_its_cases_are_computed_anew(
    kind, tmp_path, monkeypatch, registries
):
    """Cases of the former value are not taken for those of the new one."""
    name = "edited_" + kind.replace(" ", "_")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    scene = {"name": name}
    if kind == "part of a mixture":
        scene = {"name": "mixture", "scenes": [scene]}

    def truth(number):
        for file, text in EDITED[kind].items():
            path = tmp_path / file.format(name=name)
            path.parent.mkdir(exist_ok=True)
            path.write_text(text.format(name=name, value=number))
        for module in [key for key in sys.modules if key.startswith(name)]:
            del sys.modules[module]
        importlib.invalidate_caches()
        SCENES._parts.pop(name, None)
        importlib.import_module(name)
        data = SceneData(
            dict.fromkeys(("train", "test"), scene),
            {"grid": {"shape": [8, 8, 8], "spacing": 6.0}, "camera": RIG},
            {"train": 1, "val": 1, "test": 1},
            cache=str(tmp_path / "cases"),
        )
        data.setup("test")
        return data.sets["test"].prepare()["volume"].max().item()

    first = truth(0.01)
    assert truth(0.02) == pytest.approx(2 * first) and truth(0.01) == first
    assert len(list((tmp_path / "cases").iterdir())) == 2


def test_the_files_of_a_list_and_a_folder_by_its_absolute_path_are_among_a_part_s_files(tmp_path):
    """A plugin's options `paths` and `atlas`; not a word that is a folder's name, here or there."""
    files = [str(tmp_path / name) for name in ("a.nii", "b.nii")]
    for file in files:
        (tmp_path / file).write_text("values")
    scene = {"paths": files, "atlas": str(tmp_path), "mode": "tests", "each": [{"path": "tests"}]}
    assert list(files_in(scene)) == [*files, str(tmp_path), "tests"]
