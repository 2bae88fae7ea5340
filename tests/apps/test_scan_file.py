"""A scan described in one file is the same command line; what it must not say is refused."""

from pathlib import Path

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from mvrecon.apps.config import absolute_paths
from mvrecon.apps.config.grammar import CommandLine
from mvrecon.apps.scan_file import NAME, expanded, save
from mvrecon.apps.settings import ReconstructSettings
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.opening import open_projections


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "projections").mkdir()
    views = {"path": str(tmp_path / "projections"), "flip_rows": True, "every": 2}
    detector = {"pixel_mm": [0.4, 0.5]}
    camera = {"name": "circular", "sid": 400.0, "detector": detector, "angles": None}
    save(
        tmp_path / NAME,
        {"views": views, "camera": camera, "projector": None, "grid": {"spacing": 2}},
    )
    return tmp_path


def test_a_description_stands_for_the_settings_that_one_would_type(folder: Path):
    told = [
        f"views.path={folder / 'projections'}",
        "views.flip_rows=true",
        "views.every=2",
        "camera=circular",
        "camera.sid=400.0",
        "camera.detector.pixel_mm=[0.4,0.5]",
        "camera.angles=null",
    ]
    for place in (folder, folder / NAME):
        assert expanded(["method=fbp", f"scan={place}"]) == [*told, "grid.spacing=2", "method=fbp"]
    assert expanded(["grid.like=a.nii", f"scan={folder}"]) == [*told, "grid.like=a.nii"]
    assert expanded([f"scan={folder}", "camera=arc"]) == [*told[:3], "grid.spacing=2", "camera=arc"]
    assert expanded(["method=fbp"]) == ["method=fbp"]


def test_the_only_case_of_a_simulation_is_found_and_several_are_named(folder: Path):
    for name in "ab":
        (folder / "run" / "cases" / name).mkdir(parents=True)
        views = folder / "run" / "cases" / name / "views.h5"
        views.touch()
        save(views.with_name(NAME), {"views": {"path": str(views)}})
        if name == "a":
            assert expanded([f"scan={folder / 'run'}"]) == [f"views.path={views}"]
    with pytest.raises(Refused, match=r"got 2: .*/cases/a/.*, .*/cases/b/"):
        expanded([f"scan={folder / 'run'}"])
    with pytest.raises(FileNotFoundError, match=r"no scan\.yaml is there"):
        expanded([f"scan={folder / 'projections'}"])


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"plugins": {"a": "b"}}, "no section is 'plugins'. Known: camera, grid, proj"),
        ({"view": {"path": "a"}}, "did you mean 'views'"),
        ({"views": ["a"]}, "expected sections"),
        ({"views": {"path": "${oc.env:HOME}"}}, r"got \$\{oc.env:HOME\}, which is not resolved"),
        ({"views": {"path": "a/${b}/c"}}, r"got \$\{b\}, which is not resolved in scan.yaml"),
        ({"camera": {"name": "arc", "sid": "${views.every}"}}, r"got \$\{views.every\}"),
        ({"views": {"path": "a,b"}}, "as views.path, got"),
        ({"camera": {"name": "arc sid=3"}}, "as camera, got"),
        ({"camera": {"sid=3 out": 1}}, "expected names of settings in camera"),
        ("views: [", "expected sections"),
        ({"views": {"path": ""}}, "a file as views.path, got ''"),
        ({"views": {"path": "a.h5", "angles": ""}}, "a file as views.angles, got ''"),
        ({"views": {"path": "a*"}}, "as views.path, got"),
        ({"camera": {"name": "circular", "detector": "/etc ="}}, "as camera.detector, got"),
    ],
)
def test_what_is_no_description_of_a_scan_is_refused(folder: Path, told, words: str):
    (folder / NAME).write_text(yaml.safe_dump(told))
    with pytest.raises(Refused, match=words):
        expanded([f"scan={folder}"])


def test_a_folder_whose_images_are_in_a_subfolder_says_so(folder: Path):
    (folder / "projections" / "a.tif").touch()
    with pytest.raises(Refused, match=r"got none.*; there are images in .*/projections"):
        open_projections(folder)


def test_paths_begin_in_the_folder_of_the_file_and_words_are_no_paths(folder: Path, monkeypatch):
    """A file that is missing there is not that of the working folder; `circular`, `counts` and a
    data set stay words beside files of these names; a window of a file and a space are a path.
    """
    for name in ("circular", "counts", "entry", "with space"):
        (folder / name).mkdir()
    (folder / "else").mkdir()
    (folder / "else" / "missing.h5").touch()
    monkeypatch.chdir(folder / "else")
    views = {"path": "missing.h5", "kind": "counts", "dataset": "entry", "dark": "with space"}
    camera = {"name": "circular", "detector": "fit"}
    (folder / NAME).write_text(yaml.safe_dump({"views": views, "camera": camera}, sort_keys=False))
    told = [
        f"views.path={folder / 'missing.h5'}",
        "views.kind=counts",
        "views.dataset=entry",
        f"views.dark={folder / 'with space'}",
        "camera=circular",
        "camera.detector=fit",
    ]
    assert expanded([f"scan={folder}"]) == told
    for path, place in {"/x/a.h5": "/x/a.h5", "t.dcm:/window1": f"{folder}/t.dcm:/window1"}.items():
        (folder / NAME).write_text(yaml.safe_dump({"views": {"path": path}}))
        assert expanded([f"scan={folder}"]) == [f"views.path={place}"]


def test_paths_from_home_and_numbers_with_an_exponent(folder: Path, monkeypatch):
    """5e4, a text in YAML, is a number unless it is the name of a file."""
    home = folder / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("USERPROFILE", str(home))
    (folder / "1e3").touch()
    views = {"path": "~/a.h5", "flat": "5e4", "dark": "1e3", "floor": "1e-5"}
    (folder / NAME).write_text("views: {path: ~/a.h5, flat: 5e4, dark: 1e3, floor: 1e-5}")
    assert yaml.safe_load((folder / NAME).read_text()) == {"views": views}
    assert expanded([f"scan={folder}"]) == [
        f"views.path={home}/a.h5",
        "views.flat=5e4",
        f"views.dark={folder}/1e3",
        "views.floor=1e-5",
    ]


@pytest.mark.parametrize("name", ["2020", "001", "20240131", "2024-01-31", "12:30", "1_0", "1.5"])
def test_paths_may_look_like_numbers_and_dates(folder: Path, monkeypatch, name: str):
    """As they are typed, in the folder of the file and never in the working folder, where others
    of the name they would have as numbers may be; a pattern is a text.
    """
    for number in (name, str(yaml.safe_load(name))):
        (folder / "else" / number).mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(folder / "else")
    for there in (False, True):
        if there:
            (folder / name).mkdir()
        (folder / NAME).write_text(f"views: {{path: {name}, pattern: {name}, bad_pixels: {name}}}")
        words = CommandLine.of(expanded([f"scan={folder}"])).overrides
        told = {
            word.key_or_group: word.value()
            for word in OverridesParser.create().parse_overrides(words)
        }
        path = str(folder / name)
        assert told == {"views.path": path, "views.pattern": name, "views.bad_pixels": path}


@pytest.mark.filterwarnings("error")
def test_a_number_that_is_the_name_of_a_file_is_named(folder: Path, monkeypatch):
    """On a command line and in a description, where quotes make a name of it, also as `save`
    writes them. Also tried: exponents, files, signs.
    """
    monkeypatch.chdir(folder)
    (folder / "2020").mkdir()
    for key in ("views.flat", "views.dark"):
        with pytest.warns(UserWarning, match=rf"{key}=2020 is taken for a number.*{key}=./2020"):
            assert CommandLine.of([f"{key}=2020"]).overrides == [f"{key}=2020"]
        for word in (f"{key}=./2020", f"{key}=2020.0", f"{key}=2021"):
            assert CommandLine.of([word]).overrides == [word]
    assert CommandLine.of(["camera.n_views=2020"]).overrides == ["camera.n_views=2020"]
    assert CommandLine.of(["views.path=2020"]).overrides == ["views.path='2020'"]
    (folder / "true").mkdir()
    assert CommandLine.of(["views.dark=true"]).overrides == ["views.dark='true'"]
    save(folder / NAME, {"views": {"path": "projections", "flat": 2020, "dark": "2020"}})
    for _ in range(2):
        with pytest.warns(UserWarning, match="2020 is taken for a number.*'2020' in quotes"):
            told = CommandLine.of(expanded([f"scan={folder}"])).overrides
        assert told[1:] == ["views.flat=2020.0", f"views.dark={folder}/2020"]
        (folder / NAME).write_text("views: {path: projections, flat: 2020, dark: '2020'}")
    (folder / NAME).write_text("views: {path: projections, flat: 2021, dark: '5e3'}")
    assert expanded([f"scan={folder}"])[1:] == ["views.flat=2021", "views.dark=5e3"]


@pytest.mark.parametrize("mu", [0.015, 0, 1e-05, "0.5", "measured", "mu.mha"])
def test_numbers_of_options_that_may_be_paths_are_numbers(folder: Path, monkeypatch, mu):
    """Attenuation of the projector, as typed and as `save` writes it; only a file's own name is a
    path. Also tried: flat and dark fields, a list of angles.
    """
    pytest.importorskip("mvrecon_spect")
    monkeypatch.chdir(folder)
    for name in ("0.5", "mu.mha"):
        (folder / name).touch()
    expected = str(folder / mu) if mu in ("0.5", "mu.mha") else mu
    text = f"projector: {{name: spect, mu: {mu!r}}}"
    for write in (
        lambda: (folder / NAME).write_text(text),
        lambda: save(folder / NAME, {"projector": {"name": "spect", "mu": mu}}),
    ):
        write()
        (_, told) = OverridesParser.create().parse_overrides(expanded([f"scan={folder}"]))
        assert told.value() == expected


@pytest.mark.parametrize("name", ["a b (c)", "a,b", "x=1", "[0]", "it's", "a#b", "ä", "{x}", "%$!"])
def test_names_of_data_sets_may_have_any_characters(folder: Path, name: str):
    """As `save` writes them; also tried: every option of views that has names."""
    keys = ("angles", "image_key", "flat", "dark", "exposure")
    save(folder / NAME, {"views": {"path": "a.h5", **dict.fromkeys(keys, f"entry/{name}")}})
    told = OverridesParser.create().parse_overrides(expanded([f"scan={folder}"]))
    assert {one.value() for one in told[1:]} == {f"/entry/{name}"}


def test_names_of_data_sets_are_no_paths(folder: Path):
    """Written by hand or by `save`, with or without a slash; one of another file begins in the
    folder of the description. Fields and exposures may be files.
    """
    views = {"path": "a.h5", "dataset": "entry/data", "angles": "entry/x", "image_key": "/key"}
    (folder / NAME).write_text(
        yaml.safe_dump({"views": {**views, "flat": "/entry/open"}}, sort_keys=False)
    )
    assert expanded([f"scan={folder}"]) == [
        f"views.path={folder}/a.h5",
        "views.dataset=entry/data",
        "views.angles=/entry/x",
        "views.image_key=/key",
        "views.flat=/entry/open",
    ]
    (folder / "b.h5").touch()
    for angles in ("b.h5:/entry/x", f"{folder}/b.h5:/entry/x"):
        (folder / NAME).write_text(yaml.safe_dump({"views": {"angles": angles}}))
        assert expanded([f"scan={folder}"]) == [f"views.angles={folder}/b.h5:/entry/x"]
    save(folder / NAME, {"views": {"angles": "entry/x"}})
    assert expanded([f"scan={folder}"]) == ["views.angles=/entry/x"]


def test_a_name_told_twice_and_one_that_refers_are_refused(folder: Path):
    (folder / NAME).write_text("camera: {name: circular, sid: 400, sid: 500}")
    with pytest.raises(Refused, match="every name once, got several 'sid'"):
        expanded([f"scan={folder}"])
    (folder / "${oc.env:HOME}").mkdir()
    for text in ("views: {path: '${oc.env:HOME}'}", "views: {path: ${oc.env:HOME}}"):
        (folder / NAME).write_text(text)
        with pytest.raises(Refused, match=r"got \$\{oc.env:HOME\}, which is not resolved"):
            expanded([f"scan={folder}"])
    (folder / NAME).write_text("# as ${oc.env:HOME}\nviews: {every: 2}  # ${a}\n")
    assert expanded([f"scan={folder}"]) == ["views.every=2"]


@pytest.mark.parametrize("name", ["ExposureTime", "count_time*control/data", "a.csv"])
def test_names_of_exposures_are_no_paths(name: str, folder: Path, monkeypatch):
    """Written by hand, also with blanks, or by `save`; a table beside the description is one."""
    (folder / "a.csv").touch()
    expected = [f"views.exposure={folder / name if name == 'a.csv' else name}"]
    blanks = {"views": {"exposure": name.replace("*", " * ")}}
    (folder / NAME).write_text(yaml.safe_dump(blanks))
    assert [word.replace(" ", "") for word in expanded([f"scan={folder}"])] == expected
    assert absolute_paths(blanks, ReconstructSettings) == blanks or name == "a.csv"
    monkeypatch.chdir(folder)
    save(folder / NAME, {"views": {"exposure": name}})
    assert expanded([f"scan={folder}"]) == expected


@pytest.mark.parametrize(
    "pattern",
    [
        *("scan [0-9]*.tif", "a, (b) = {c}_*", "it's \"*", "view_*.tif"),
        *(
            "001*",
            "1e1",
            "null",
            "2020",
            "007",
            "true",
            ".5",
            "nan",
            " a ",
            "1_0",
            "a,b",
            "~",
            "on",
        ),
    ],
)
def test_patterns_and_names_of_data_sets_are_kept_with_any_characters(pattern: str, folder: Path):
    """As `save` writes them and Hydra reads them; what refers or controls terminals is refused."""
    views = {"pattern": pattern, "dataset": f"/entry/{pattern}"}
    save(folder / NAME, {"views": views})
    told = OverridesParser.create().parse_overrides(expanded([f"scan={folder}"]))
    assert {one.key_or_group: one.value() for one in told} == {
        f"views.{name}": text for name, text in views.items()
    }
    assert yaml.safe_load((folder / NAME).read_text()) == {"views": views}
    for odd in ("\\x24{every}", "a\\nb", "\\x1b[2J"):
        (folder / NAME).write_text(f'views: {{pattern: "{odd}"}}')
        with pytest.raises(Refused, match=r"as views.pattern, got"):
            expanded([f"scan={folder}"])


@pytest.mark.parametrize("typed", ["scan={}", "+scan={}", "scan='{}'", 'scan="{}"'])
def test_a_scan_is_taken_as_typed(folder: Path, typed: str):
    assert expanded([typed.format(folder), "+grid.size=8"])[-2:] == [
        "camera.angles=null",
        "+grid.size=8",
    ]


@pytest.mark.parametrize("typed", [["scn=a"], ["scans=a"], ["sacn=a"]])
def test_a_typo_of_scan_names_it(typed: list[str]):
    with pytest.raises(LookupError, match="did you mean 'scan'"):
        expanded(typed)
    with pytest.raises(Refused, match="scan=FOLDER once"):
        expanded(["scan="])


@pytest.mark.parametrize("word", ["count_time", "ExposureTime*XRayTubeCurrent", "control/data"])
def test_an_exposure_by_name_is_no_path(folder: Path, monkeypatch, word: str):
    """Neither on a command line nor in a description; the name of a file is one."""
    monkeypatch.chdir(folder)
    (folder / "count_time.csv").touch()
    for given, typed, told in (
        (word, word, word),
        ("count_time.csv", f"{folder}/count_time.csv", f"{folder}/else/../count_time.csv"),
    ):
        settings = absolute_paths({"views": {"exposure": given}}, ReconstructSettings)
        assert settings["views"]["exposure"] == typed
        save(folder / "else" / NAME, {"views": {"exposure": given}})
        assert expanded([f"scan={folder}/else"]) == [f"views.exposure={told}"]


@pytest.mark.parametrize("name", ["a(1).h5", "a,b.h5", "it's.h5", "x{1}=#.h5", 'ä "[0] b.h5'])
def test_data_sets_are_in_files_of_any_name(folder: Path, monkeypatch, name: str):
    """As `save` writes them, and as typed: of angles, fields, exposures; also tried: $, ~ and
    blanks, in folders of such names, and names of data sets with brackets.
    """
    monkeypatch.chdir(folder)
    (folder / name).touch()
    for key in ("angles", "flat", "exposure"):
        for inside in ("/entry/x", "entry/x (1)"):
            save(folder / "else" / NAME, {"views": {key: f"{name}:{inside}"}})
            (told,) = CommandLine.of(expanded([f"scan={folder}/else"])).overrides
            (typed,) = CommandLine.of([f"views.{key}={name}:{inside}"]).overrides
            read = [OverridesParser.create().parse_override(line).value() for line in (told, typed)]
            assert read == [f"{folder}/else/../{name}:{inside}", f"{name}:{inside}"]
    told = {"views": {"angles": f"../{name}:/a\x1b[2J"}}
    (folder / "else" / NAME).write_text(yaml.safe_dump(told))
    with pytest.raises(Refused, match="a file as views.angles"):
        expanded([f"scan={folder}/else"])
