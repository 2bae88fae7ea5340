"""Every experiment composes; a typing mistake is an error; only allowed classes are built from a
config.
"""

import random
import re
import sys
from dataclasses import asdict, fields
from importlib.metadata import EntryPoint
from itertools import zip_longest
from pathlib import Path

import hydra
import pytest
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException, MissingConfigException

from mvrecon.apps import config
from mvrecon.apps.config import choices, compose, conf_dir, help_text, texts_of
from mvrecon.apps.config.errors import sentence
from mvrecon.apps.config.grammar import CommandLine
from mvrecon.apps.settings import RECORDS, TrainSettings
from mvrecon.core import options as core_options, parts as core_parts, registry
from mvrecon.core.registry import GROUP, import_plugins
from mvrecon.training.targets import instantiate

NAMES = [name for record in RECORDS.values() for name in texts_of(record)]
EXPERIMENTS = sorted(p.stem for p in (conf_dir() / "experiment").glob("*.yaml"))
EVALUATIONS = {"chest_ct", "quickstart_rig_errors"}  # experiments of mvrecon-eval


def plain(node: object) -> bool:
    if isinstance(node, dict):
        return all(type(key) is str and plain(value) for key, value in node.items())
    if isinstance(node, list):
        return all(map(plain, node))
    return node is None or type(node) in (str, int, float, bool)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_to_plain_values(name: str):
    app = ("checkpoint=x", "eval") if name in EVALUATIONS else ("resume=null", "train")
    settings = compose(f"experiment={name}", app[0], config_name=app[1])
    assert settings["name"] == name
    assert plain(settings)


def needed_in(options: dict, above: str = "") -> list[str]:
    """Required settings of a file, as dotted names."""
    inner = [
        name
        for key, value in options.items()
        if isinstance(value, dict)
        for name in needed_in(value, f"{above}{key}.")
    ]
    return inner + [f"{above}{key}" for key, value in options.items() if value == "???"]


#: Groups whose part is an option of the method.
NESTED = {kind: f"+{kind}@method.{kind}" for kind in ("head", "weighting", "network")}


@pytest.mark.parametrize("groups", [("scene", "camera", "projector", "method"), (*NESTED,)])
def test_every_option_of_a_group_names_a_part_and_composes(groups: tuple[str, ...]):
    """A file of each group at once: a composition takes long."""
    from mvrecon.core.parts import REGISTRIES

    files = [sorted((conf_dir() / group).glob("*.yaml")) for group in groups]
    assert all(files)
    for row in zip_longest(*files):
        chosen = {group: file for group, file in zip(groups, row, strict=True) if file}
        lines = ["method=world_unet"] if groups == (*NESTED,) else []
        for group, file in chosen.items():
            key = NESTED.get(group, group)
            needed = needed_in(yaml.safe_load(file.read_text()))
            lines += [f"{key}={file.stem}"]
            lines += [f"{key.partition('@')[2] or key}.{name}=x" for name in needed]
        node = compose(*lines)
        for group in chosen:
            part = (node["method"] if group in NESTED else node)[group]
            assert part["name"] in REGISTRIES[group].names()


@pytest.mark.parametrize("choice", ["method=world_unet", "method=mean_fusion", "camera=random"])
def test_the_smallest_experiment_composes_with_any_model_and_camera_file(choice: str):
    group = choice.partition("=")[0]
    assert compose("experiment=smoke", choice)[group] == compose(choice)[group]


def test_every_file_of_acquisitions_sets_every_option():
    """But for those of `disturbed`."""
    from mvrecon.data.acquisition.detector import Acquisition

    files = sorted((conf_dir() / "acquisition").glob("*.yaml"))
    assert files
    for file in files:
        node = compose(f"acquisition={file.stem}")["acquisition"]
        made = asdict(Acquisition.of(node))
        if node["disturbed"]:
            node = {**node, "disturbed": {**made["disturbed"], **node["disturbed"]}}
        assert made == node
    assert Acquisition.of(compose()["acquisition"]) == Acquisition()


def test_a_group_takes_a_mapping_of_settings():
    """Over those of its choice, as any setting does."""
    given = compose("trainer={max_steps: 3}", "camera={n_views: 5}")
    assert given["trainer"]["max_steps"] == 3 and given["trainer"]["log_every_n_steps"] == 10
    assert given["camera"]["name"] == "circular" and given["camera"]["n_views"] == 5


def test_every_option_of_a_method_composes_with_every_experiment():
    """Options are flat and match the signature."""
    options = {"head": "density", "fusion": "mean", "depth": "uniform"}
    for experiment in ("quickstart", "open_kbp", "smoke"):
        lines = [f"method.{key}={value}" for key, value in options.items()]
        method = compose(f"experiment={experiment}", *lines)["method"]
        assert {key: method[key] for key in options} == options
    assert compose("camera.arc_degrees=200")["camera"]["arc_degrees"] == 200
    tv = compose("experiment=wrong_cameras", "compare.tv.iterations=7")["compare"]["tv"]
    assert tv == {"name": "fista_tv", "weight": 1e-4, "iterations": 7}


def test_a_network_is_chosen_on_the_command_line():
    line = "+network@method.network=unet"
    assert compose("method=world_unet", line)["method"]["network"] == {"name": "unet"}


def test_a_path_is_one_value_whatever_characters_it_contains(tmp_path: Path):
    """The folder of a sweep's run, with = and commas in its name, and a folder with spaces or
    quotes, is one value on the command line; other arguments are unchanged.
    """
    parser = OverridesParser.create()
    for name in ("camera.n_views=4,method=sirt", "my scan (2)", "o'brien, {3}"):
        (tmp_path / name).mkdir()
        lines = CommandLine.of([f"checkpoint={tmp_path / name}"]).overrides
        assert parser.parse_overrides(lines)[0].value() == str(tmp_path / name)
    for line in ("method=sirt,cross_view", "data.sizes={train: 3}", "seed=3"):
        assert CommandLine.of([line]).overrides == [line]


NEW = [
    *("vü.nii.gz", "a(1).nii.gz", "Röntgen", "a,b", "a, (b", "x=1", "o'brien", "'a'b", 'say "a" b'),
    *(
        "$x",
        "😀",
        "-x",
        "--x",
        "-",
        "[1].nii.gz",
        "[1]",
        "{a}",
        "{a: 1}",
        "(",
        "a)",
        "]",
        "{",
        "#1",
    ),
    *(
        "~/a",
        "C:\\x",
        "a\\",
        "a\\'b\\",
        "a\nb",
        "a\tb",
        "1_000",
        "1e3",
        "007",
        "-0",
        "1.50",
        "true",
    ),
    *(
        "nan",
        "a;b",
        "a&b|c",
        "a<b>",
        "choice",
        "a(b, c)",
        "a  b",
        "\u00a0x",
        "日本.h5",
        "a`b!^%*?@",
    ),
]


def test_a_new_name_may_have_any_characters():
    """Where nothing of that name exists: letters beyond ASCII, brackets, commas, signs, quotes,
    backslashes, what looks like a number, a list or a mapping; as a setting of the app, a path of a
    part, and Hydra's folder; and random texts of these characters.
    """
    rng = random.Random(0)
    texts = ["".join(rng.choices("".join(NEW), k=rng.randint(1, 9))) for _ in range(100)]
    texts = [
        text for text in texts if text == text.strip() and not quoted(text) and "${" not in text
    ]
    for key in ("out", "views.path", "hydra.run.dir"):
        for name in (*NEW, *texts) if key == "out" else NEW:
            text = name if key == "out" else f"über {name}"
            (line,) = CommandLine.of([f"{key}={text}"], (), NAMES).overrides
            assert OverridesParser.create().parse_override(line.lstrip("+")).value() == text, line


def quoted(text: str) -> bool:
    """Whether Hydra takes a text's quotes for its own, or a function."""
    return text[0] in "'\"" or re.fullmatch(r"choice\(.*\)", text) is not None


def test_a_composed_setting_is_the_typed_text():
    """Of every app, beside an interpolation and within the name of the run's folder."""
    for app in ("train", "simulate", "reconstruct", "eval"):
        own = {"reconstruct": VIEWS, "eval": ("checkpoint=läufe (1)/x, y",)}.get(app, ())
        settings = compose("name=Röntgen (1), [é] = o'b 😀", *own, config_name=app)
        assert settings["name"] == "Röntgen (1), [é] = o'b 😀"
    assert settings["checkpoint"] == "läufe (1)/x, y"


VIEWS = ("views.path=x", "camera.path=y")


def test_paths_in_lists_mappings_and_sweeps_are_quoted_one_by_one():
    """What Hydra's grammar has a meaning for keeps it: numbers, null, lists, mappings, quotes,
    interpolations, sweeps and their functions; errors in brackets remain Hydra's.
    """
    options = ("scatter={name: given, path: ä/s.h5, n: [1, é, null]}", "out=${name}/vü", *VIEWS)
    settings = compose("plugins=[]", *options, "name=ö", config_name="reconstruct")
    assert settings["scatter"] == {"name": "given", "path": "ä/s.h5", "n": [1, "é", None]}
    assert settings["out"] == "ö/vü"
    assert compose("label=null", "init_from='a b'", "method=sirt")["init_from"] == "a b"
    unchanged = (
        "seed=1_000",
        "method=sirt,cross_view",
        "camera.n_views=4,8",
        "grid.size=[8,8",
        "~x",
    )
    unchanged += (
        "out=",
        "name=choice(a,b)",
        "x=range(1,3)",
        "x=[a,[b]]",
        "label=${x:a,b}",
        "+x={a:b}",
    )
    assert CommandLine.of(unchanged, (), NAMES).overrides == list(unchanged)
    sweep = CommandLine.of(["-m", "name=ü,b", "label=a(1),[c],1", "out=a,b"], (), NAMES)
    assert sweep.overrides == ["name='ü',b", "label='a(1)',[c],1", "out=a,b"]
    (jobs,) = [o for o in OverridesParser.create().parse_overrides(sweep.overrides[:1])]
    assert list(jobs.sweep_string_iterator()) == ["'ü'", "b"]


def test_a_number_is_a_path_where_the_option_takes_no_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """And such a path exists; a number where it takes one, as grey values without a beam, which are
    a number or a path.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "2024_01").touch()
    lines = ["views.path=2024_01", "views.path=2024_02", "views.dark=2024_01", "seed=2024_01"]
    assert CommandLine.of(lines).overrides == ["views.path='2024_01'", *lines[1:]]


@pytest.mark.parametrize("text", ["a,b", "[a", "{a", "[", "scan_[12", "a, {b}c"])
def test_texts_of_sections_are_texts_whatever_hydra_would_read(text: str):
    """Patterns and names of data sets as well as paths; also tried: options of parts."""
    for key in ("views.pattern", "views.dataset", "views.path", "scene.path"):
        (line,) = CommandLine.of([f"{key}={text}"]).overrides
        assert OverridesParser.create().parse_override(line).value() == text


def test_folders_of_configs_may_have_any_characters(tmp_path: Path):
    folder = tmp_path / "für (mich), o'brien [1]"
    (folder / "experiment").mkdir(parents=True)
    text = "# @package _global_\nname: mine\nseed: 7\n"
    (folder / "experiment" / "röntgen.yaml").write_text(text)
    command = CommandLine.of([f"--config-dir={folder}", "experiment=röntgen"])
    assert command.folders == [str(folder)]
    for options in ([f"--config-dir={folder}"], [f"hydra.searchpath=['{tmp_path / 'a'}']"]):
        assert CommandLine.of(options).folders
    assert compose(f"--config-dir={folder}", "experiment=röntgen")["seed"] == 7
    assert CommandLine.of(["hydra.searchpath=[/zürich, /b]"]).folders == ["/zürich", "/b"]


@pytest.fixture
def user_conf(tmp_path: Path):
    """A user's own experiment beside ours, as `--config-dir` finds it."""

    def write(text: str) -> list[str]:
        (tmp_path / "experiment").mkdir(exist_ok=True)
        (tmp_path / "experiment" / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
        return [f"hydra.searchpath=[file://{tmp_path}]", "experiment=mine"]

    return write


def test_a_mistyped_key_in_an_experiment_is_an_error(user_conf):
    words = (
        "experiment/mine sets 'projectr', which is no setting of this app; did you mean 'projector'"
    )
    with pytest.raises(LookupError, match=words):
        compose(*user_conf("name: mine\nprojectr: {name: drr}"))


def test_a_mistyped_choice_in_an_experiment_lists_what_there_is(user_conf):
    with pytest.raises(
        MissingConfigException, match=r"Could not find 'projector/dr'(.|\n)*drr(.|\n)*radon"
    ):
        compose(*user_conf("defaults:\n  - override /projector: dr\nname: mine"))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("projectr=drr", "projectr"),
        ("projector=dr", "drr(.|\n)*radon"),
        ("gird.shape=[4,4,4]", "gird"),
    ],
)
def test_a_mistyped_override_is_an_error_that_names_it(override: str, message: str):
    """A misspelt key or choice on the command line is refused, named or with the choices that there
    are.
    """
    with pytest.raises((ConfigCompositionException, MissingConfigException)) as error:
        compose(override)
    assert re.search(message, f"{error.value}{error.value.__cause__}")


def test_an_experiment_may_add_compared_models(user_conf):
    settings = compose(*user_conf("defaults:\n  - /method@compare.sirt: sirt\nname: mine\nseed: 4"))
    assert settings["seed"] == 4
    assert settings["compare"]["sirt"]["name"] == "sirt"


def test_a_missing_required_setting_is_named():
    with pytest.raises(LookupError, match="must be given: checkpoint=..."):
        compose(config_name="eval")


def test_a_running_hydra_is_left_alone():
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        with pytest.raises(RuntimeError, match="in use already"):
            compose()
        assert GlobalHydra.instance().is_initialized()
    assert not GlobalHydra.instance().is_initialized()


def test_a_plugin_provides_its_choices_even_if_its_code_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "a_plugin" / "conf"
    (folder / "projector").mkdir(parents=True)
    for package in (folder, folder.parent):
        (package / "__init__.py").touch()
    (folder / "projector" / "mine.yaml").write_text("name: mine\nwidth: 2\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (folder.parent / "__init__.py").write_text("raise OSError('this plugin is broken')\n")
    points = (
        EntryPoint("conf.mine", "a_plugin.conf", GROUP),
        EntryPoint("conf.gone", "no_such_plugin.conf", GROUP),
    )
    monkeypatch.setattr(choices, "installed", lambda: points)
    assert compose("projector=mine")["projector"] == {"name": "mine", "width": 2}
    assert "Choices: drr, mine, radon\n" in help_text("train")


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A plugin with parts and without config files; one needs a path, one does not import."""
    source = """
from mvrecon.operators.drr import Drr

class Lab(Drr):
    \'\'\'Our own.\'\'\'

class Head:
    \'\'\'Our own.\'\'\'

def rig(path: str, turns: int = 1):
    \'\'\'From our own file.\'\'\'
"""
    (tmp_path / "lab_parts.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    parts = {"projector.lab": "Lab", "camera.lab": "rig", "head.lab": "Head", "method.lab": "gone"}
    points = [EntryPoint(name, f"lab_parts:{part}", GROUP) for name, part in parts.items()]
    known = registry.installed()
    for module in (registry, core_parts, choices):
        monkeypatch.setattr(module, "installed", lambda: (*known, *points))
    yield
    for name in parts:
        ConfigStore.instance().repo[name.partition(".")[0]].pop("lab.yaml", None)


@pytest.mark.usefixtures("lab")
def test_an_installed_part_without_a_file_is_chosen_by_its_name():
    """Of any kind, also one inside another, and one that does not import; options that a part needs
    must be given, and others may be; one with a file keeps that.
    """
    assert compose("projector=lab")["projector"] == {"name": "lab"}
    assert compose("projector=lab", "projector.method=siddon")["projector"]["method"] == "siddon"
    assert compose("method=lab")["method"] == {"name": "lab"}
    assert compose("+head@method.head=lab")["method"]["head"] == {"name": "lab"}
    assert compose("+method@compare.lab=lab")["compare"]["lab"] == {"name": "lab"}
    with pytest.raises(LookupError, match="must be given: camera.path="):
        core_options.check(compose("camera=lab"), TrainSettings, complete=True)
    assert compose("camera=lab", "camera.path=x")["camera"] == {"name": "lab", "path": "x"}
    assert compose("camera=circular")["camera"]["n_views"] == 8
    with pytest.raises(MissingConfigException) as error:
        compose("projector=la")
    assert "did you mean 'lab'?" in sentence(error.value)
    assert re.search(r"\n  projector=null\n.*\n +Choices: .*\blab\b", help_text("simulate"))


def test_the_help_shows_every_choice_and_setting_of_the_app():
    taken = {
        "train": {
            "scene",
            "camera",
            "projector",
            "method",
            "head",
            "weighting",
            "network",
            "optimizer",
        },
        "eval": {"scene", "acquisition", "experiment"},
        "simulate": {"scene", "camera", "projector", "acquisition"},
        "reconstruct": {"camera", "projector", "method", "correct"},
    }
    for app, groups in taken.items():
        text = help_text(app)
        assert f"mvrecon-{app} [group=choice ...]" in text
        for group in groups:
            assert all(file.stem in text for file in (conf_dir() / group).glob("*.yaml")), group
        assert "override hydra" not in text
        names = [setting.name for setting in fields(RECORDS[app])]
        assert all(re.search(rf"^  (\w+@)?{name}\b", text, re.MULTILINE) for name in names)
    assert "\n  left_out=false\n      Also predicts each view" in help_text("reconstruct")
    for app, group in {
        "simulate": "optimizer",
        "eval": "method",
        "reconstruct": "optimizer",
    }.items():
        assert not re.search(rf"^  {group}=", help_text(app), re.MULTILINE)


def test_the_app_answers_help_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["mvrecon-train", "experiment=quickstart", "--help"])
    config.launch(lambda settings: pytest.fail("the task must not run"), "train")
    assert capsys.readouterr().out == help_text("train")


def test_plugin_modules_are_imported_and_a_broken_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "good_plugin_module.py").write_text("from mvrecon.core import parts\nmade = 1\n")
    (tmp_path / "bad_plugin_module.py").write_text("import mvrecon\n1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import_plugins(["good_plugin_module"])
    assert sys.modules["good_plugin_module"].made == 1
    with pytest.raises(ImportError, match="'bad_plugin_module'.*division by zero"):
        import_plugins(["bad_plugin_module"])


def test_a_target_of_an_allowed_library_is_built(tmp_path: Path):
    timer = instantiate(
        {"_target_": "lightning.pytorch.callbacks.Timer", "duration": "00:00:01:00"}, tmp_path
    )
    assert timer.time_remaining() == 60.0


def test_the_sweep_flag_may_be_at_any_position():
    """Hydra's own parser takes it before or behind all settings, not between two."""
    command = CommandLine.of(["experiment=smoke", "-m", "seed=0,1", "logger=csv"])
    assert command.flags == ["-m"] and command.sweeps
    assert command.overrides == ["experiment=smoke", "seed=0,1", "logger=csv"]
