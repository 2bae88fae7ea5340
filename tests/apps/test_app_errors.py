"""A mistyped setting is answered in one line, with the nearest name, before torch is imported."""

import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import pytest
from hydra.errors import MissingConfigException
from jaxtyping import Bool, Float
from omegaconf import OmegaConf
from torch import Tensor

from mvrecon import __version__
from mvrecon.apps import compare, warmup
from mvrecon.apps.config import compose, conf_dir, launch
from mvrecon.apps.config.errors import one_line, sentence
from mvrecon.apps.settings import ReconstructSettings, TrainSettings
from mvrecon.core import registry
from mvrecon.core.files.atomic import written_whole
from mvrecon.core.options import check, fits
from mvrecon.core.parts import PROJECTORS
from mvrecon.core.quantities import NonNegativeFloat, Pair, PositiveFloat, PositiveInt
from mvrecon.core.registry import check_plugins, import_plugins, names
from mvrecon.geometry.cameras.camera import Cameras

MISTAKES = {
    "camera.view=4": r"the camera 'circular'.* has no option 'view'; did you mean 'n_views'\?",
    "method=crossview": r"method has no choice 'crossview'; did you mean 'cross_view'\?",
    "camera.n_views=abc": r"camera.n_views: expected int > 0, got 'abc' \(number of cameras",
    "grid.spacing=x": r"grid.spacing: expected float > 0 or \[float > 0, .*\], got 'x' \(.*mm",
    "grid.size=[32,32]": r"grid.size: expected int > 0 or \[int > 0, .*, got \[32, 32\]",
    "trainer.max_steps=-5": r"trainer.max_steps: expected int > 0 or -1, got -5$",
    "trainer.check_val_every_n_epoch=0": r"expected int > 0 or null, got 0",
    "projector.name=dr": r"projector.name: no projector is 'dr'; did you mean 'drr'\?",
    "+projector.metod=joseph": r"'metod'; did you mean 'method'\?",
    "plugins=no_such_module": r"ModuleNotFoundError: .* names 'no_such_module'",
    "methd=sirt": r"There is no setting 'methd'; did you mean 'method'\?",
    "seed=x": r"seed: expected int >= 0, got 'x' \(Number of the series of random cases\)$",
    "n_views=4": r"There is no setting 'n_views'; did you mean camera.n_views\?",
    "weighting=unet": r"'weighting' is a part of a method; to choose it: method.weighting=...",
    "head=density": r"'head' is a part of a method; to choose it: method.head=...",
    "+method.start={name: world_unet}": r"method.start.name: expected a classical method, got the",
    "+method.start={name: srt}": r"method.start.name: no method is .srt.; did you mean .sirt.\?",
    "+method.start={name: sirt, iteratons: 3}": r"'iteratons'; did you mean 'iterations'\?",
    "+foo=1": r"This app has no option 'foo'",
    "callbacks.borad.every=2": r"callbacks.borad has no _target_ and no name; did you mean 'board'",
    "callbacks.board.evry=2": r"the callback 'TensorBoardReview'.* 'evry'; did you mean 'every'",
    "callbacks.board.every=x": r"callbacks.board.every: expected int.*, got 'x'",
    "+callbacks.a={_target_: os.system}": r"_target_ 'os.system' is not allowed; expected a class",
    "+callbacks.a={name: x}": r"callbacks.a.name: no callback is 'x'",
    "method=": r"method: expected one of aligned, .*, got ''$",
    "resume=": r"resume: expected path or null, got '' \(A run folder",
    "device=gup": r"device: expected auto or cpu or gpu or cuda, got 'gup'",
    "method.head=softmax": r"method.head: no head is 'softmax'; did you mean 'softmax_depth'\?",
    "callbacks.borad=null": r"There is no setting 'callbacks.borad'; did you mean 'board'\?",
    "camera.n_views=${foo}": r"camera.n_views takes its value from \$\{foo\}, which has none here",
    "logger.table.save_dir=x": r"the logger 'MetricsFile'.* has no option 'save_dir'",
}


def reached(*_: object) -> None:
    raise AssertionError("the task was called")


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """What an app writes to the error stream for a command line, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def run(*overrides: str, task=reached, app: str = "train") -> str:
        monkeypatch.setattr(sys, "argv", [f"mvrecon-{app}", *overrides])
        with pytest.raises(SystemExit) as stop:
            launch(task, app)
        assert stop.value.code
        return capsys.readouterr().err

    return run


def test_an_option_that_an_experiment_sets_for_another_method_has_a_remedy(answer):
    options = ["experiment=open_kbp", "method=uncertain"]
    assert "has no option 'support'. Known: " in (text := answer(*options))
    assert "; ~method.support removes it" in text
    check(compose(*options, "~method.support"), TrainSettings)


def test_warnings_that_differ_in_numbers_alone_are_one_line_and_counted(
    capsys: pytest.CaptureFixture[str],
):
    """As those of training steps; other texts and other names are lines of their own, also of files
    that differ in their numbers, as of the jobs of a sweep.
    """
    with one_line("mvrecon-train"):
        for number in range(5):
            text = f"In {number} of 8 views {number / 3:.1f}% are cut, [{number}, {number / 1e9}]"
            sys.stderr.write(warnings.formatwarning(text, UserWarning, "fdk.py", 3))
        names = ("a.tif", "b.tif", "scan1/0/", "scan1/1/", "1.h5", "2.h5", "/1", "/2")
        for name in names:
            sys.stderr.write(warnings.formatwarning(f"{name}: 7 keys", UserWarning, "t.py", 1))
    assert capsys.readouterr().err.splitlines() == [
        "mvrecon-train: UserWarning: In 0 of 8 views 0.0% are cut, [0, 0.0]",
        *(f"mvrecon-train: UserWarning: {name}: 7 keys" for name in names),
        "mvrecon-train: warnings that repeat these with other numbers: 4",
    ]


@pytest.mark.parametrize("override", MISTAKES)
def test_a_mistake_on_the_command_line_is_one_line_with_the_nearest_name(
    override: str, answer, tmp_path: Path
):
    """A mistyped setting, choice, value or plugin is reported in one line, with the nearest name,
    before a folder is created.
    """
    text = answer(override)
    assert text.startswith("mvrecon-train: ") and text.count("\n") == 1, text
    assert re.search(MISTAKES[override], text.strip()), text
    assert not list(tmp_path.iterdir())


WORDS = {
    "train": "experiment=quickstart",
    "simulate": "scene=shepp_logan",
    "reconstruct": "views.path=scan/",
    "eval": "checkpoint=outputs/quickstart/",
}


@pytest.mark.parametrize("app", WORDS)
@pytest.mark.parametrize(
    "words",
    [
        *(["a.h5"], ["seed=1", "a b"], ["-m", "out"], ["--cfg", "job", "scan/x.yaml"]),
        *(["grid[size]=8"], ["gríd.size=8"], ["grid.size =8"], ["=8"], ["+=8"], ["~"], [".a=1"]),
        *(["a..b=1"], ["grid.=1"], ["\N{EM DASH}grid.size=8"], ["'grid.size=8'"]),
    ],
)
def test_a_word_that_sets_nothing_is_answered_by_an_example(app: str, words: list[str], answer):
    """Also tried: names of settings, experiments and methods, +, the apps of plugins."""
    text = answer(*words, app=app)
    assert text.startswith(f"mvrecon-{app}: LookupError: Expected settings as key=value, such as ")
    assert WORDS[app] in text and f"got {words[-1]!r}; --help" in text and text.count("\n") == 1


def test_an_experiment_of_another_app_is_reported_as_such(answer):
    """Hydra alone would propose to override a part of the experiment."""
    text = answer("experiment=smoke", app="simulate")
    assert "experiment/smoke is for another app: it chooses 'method', which is not here" in text
    text = answer("method=sirt", app="simulate")
    assert "This app chooses no 'method'; --help shows what it chooses" in text


def test_the_method_inside_another_one_is_named_where_the_outer_one_is_replaced(answer):
    text = answer("experiment=open_kbp_faults", "method=cross_view")
    assert text == (
        "mvrecon-train: LookupError: experiment/open_kbp_faults has method around another "
        "method; to choose that: method@method.method=...\n"
    )
    inner = compose("experiment=open_kbp_faults", "method@method.method=world_unet")
    assert inner["method"]["name"] == "aligned"
    assert inner["method"]["method"]["name"] == "world_unet"


def test_a_run_without_comparisons_has_only_its_own_method():
    settings = TrainSettings(**compose("experiment=smoke", "~compare"))
    assert list(settings.methods()) == [settings.label]


def test_the_version_is_that_of_mvrecon(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["mvrecon-train", "--version"])
    launch(reached, "train")
    assert capsys.readouterr().out == f"mvrecon {__version__}\n"


def test_a_reference_to_a_missing_setting_is_named(answer, tmp_path: Path):
    """The number of cameras of a rig in a file is not a setting."""
    text = answer("method=geometry_free", "camera=from_file", "camera.path=rig.json")
    assert text == (
        "mvrecon-train: LookupError: method.n_cameras takes its value from ${camera.n_views}, "
        "which has none here; set method.n_cameras=...\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_reference_is_from_its_own_setting_and_a_part_is_chosen_from_plugins(
    tmp_path: Path, monkeypatch, registries
):
    """Both as typed on a command line."""
    text = "import mvrecon\nfrom mvrecon.core.parts import CAMERAS\n"
    text += "@CAMERAS.register('typed_rig')\ndef rig(like: str = '', sdd: float = 1.0): ...\n"
    (tmp_path / "typed_plugin.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    found = []
    for line in (
        ["camera.sdd=${.sid}", "camera.sid=300"],
        ["plugins=typed_plugin", "camera=typed_rig", "camera.sdd=300", "camera.like=sirt"],
    ):
        monkeypatch.setattr(sys, "argv", ["mvrecon-simulate", *line, "hydra.run.dir=run"])
        launch(lambda config: found.append(dict(config.camera)), "simulate")
    assert [camera["sdd"] for camera in found] == [300, 300] and found[1]["like"] == "sirt"


def test_a_missing_launcher_is_reported_with_its_extra():
    for choice, extra in {"launcher/ray": "cluster", "sweeper/optuna": "sweep"}.items():
        error = MissingConfigException("not in ...", f"hydra/{choice}", ["basic"])
        assert f"hydra/{choice} is not installed; pip install 'mvrecon[{extra}]'" in sentence(error)
    for choice in ("experiment/dcspect_cardiac", "experiment/events", "projector/spect"):
        error = MissingConfigException("not in ...", choice, ["drr"])
        assert sentence(error) == (
            f"{choice} is not installed; pip install plugins/mvrecon-spect brings it"
        )
    error = MissingConfigException("not in ...", "experiment/dcspect_cardica", ["dcspect_cardiac"])
    assert "did you mean 'dcspect_cardiac'" in sentence(error)
    error = MissingConfigException("not in ...", "hydra/launcher/jobilb", ["basic", "joblib"])
    assert "did you mean 'joblib'" in sentence(error)


def test_the_traceback_is_shown_on_request(answer, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["mvrecon-train", "method=crossview"])
    with pytest.raises(Exception, match="Could not find 'method/crossview'"):
        launch(reached, "train")


def test_user_errors_are_one_line_and_program_faults_are_not(answer):
    def refuse(config: object) -> None:
        raise ValueError("expected a,\n got b")

    def stop(config: object) -> None:
        raise KeyboardInterrupt

    assert answer(task=refuse) == "mvrecon-train: ValueError: expected a, got b\n"
    assert answer(task=stop) == "mvrecon-train: stopped by Ctrl-C\n"
    with pytest.raises(AssertionError, match="the task was called"):
        answer()


@pytest.mark.parametrize(
    ("type", "good", "bad"),
    [
        (int, [3], ["3", 3.5, True, None, [3]]),
        (float | None, [3, 3.5, None], ["3", False]),
        (bool, [True], [1, "true"]),
        (Literal["a", "b"], ["a"], ["c", None]),
        (Sequence[float] | None, [[1, 2.5], None], [["a"], 3]),
        (Literal["a"] | Literal[-1], ["a", -1], ["-1", 1]),
        (PositiveInt, [1], [0, -1, 1.5, True]),
        (NonNegativeFloat, [0, 0.5, float("inf")], [-0.1, float("nan"), "0"]),
        (Pair[PositiveFloat], [[1, 2.5]], [[1], [1, 0], [1, 2, 3], 1]),
        (tuple[int, str] | None, [[1, "a"], None], [[1], ["a", 1]]),
        (tuple[float, ...], [[], [1, 2, 3]], [["a"]]),
        (Cameras | None, [None], [{}, 3]),
        (Any, ["anything", None, {}], []),
        (Bool[Tensor, "d h w"] | None, [None], [3, "mask"]),
        (Float[Tensor, "d h w"] | float, [3.0], ["map"]),
    ],
)
def test_plain_types_are_distinguished(type: Any, good: list, bad: list):
    assert all(fits(value, type) for value in good)
    assert not any(fits(value, type) for value in bad)


def test_options_that_only_python_can_give_are_refused_and_not_offered():
    settings = {"projector": {"name": "drr", "support": 3}}
    with pytest.raises(TypeError, match=r"projector\.support: expected Bool.* or null, got 3"):
        check(settings, TrainSettings)
    with pytest.raises(TypeError, match=r"Known: assume, iterations, momentum, nonnegative;"):
        check({"method": {"name": "sirt", "steps": 3}}, TrainSettings)


WRONG = {
    "camera": [
        {"n_views": 0},
        {"sid": -400.0},
        {"detector": {"pixels": 0}},
        {"detector": {"pixels": [24, 24, 24]}},
        {"detector": {"pixel_mm": [1.0, 0.0]}},
    ],
    "scene": [{"count": [3]}, {"field": -0.4}, {"sizes": [0.1, -0.4]}],
    "grid": [{"spacing": -1}, {"centre": [0, 0]}],
    "data": [{"batch_size": 0}, {"sizes": {"train": -1}}],
    "acquisition": [{"photons": 0}],
    "optimizer": [{"lr": -1e-3}, {"schedule": "cosinus"}],
    "trainer": [{"devices": 0}, {"accumulate_grad_batches": 0}],
    "loss": [{"volume": "much"}],
    "views": [{"floor": "low"}, {"every": 1.5}],
}


def test_a_number_out_of_its_range_and_a_list_of_wrong_length_are_refused():
    """A setting that must be positive, and is not, and a list of a wrong length are refused
    before anything is computed; the message names the setting.
    """
    names = {"camera": "circular", "scene": "ellipsoids"}
    for section, nodes in WRONG.items():
        for node in nodes:
            part = {"name": names[section], **node} if section in names else node
            with pytest.raises(TypeError, match=rf"^{section}\.{next(iter(node))}.*: expected "):
                record = ReconstructSettings if section == "views" else TrainSettings
                check({section: part}, record)


def test_every_choice_matches_the_types_of_its_part():
    groups = (
        "scene",
        "camera",
        "projector",
        "method",
        "data",
        "acquisition",
        "optimizer",
        "trainer",
        "views",
    )
    for group in groups:
        for file in sorted((conf_dir() / group).glob("*.yaml")):
            part = OmegaConf.to_container(OmegaConf.load(file))
            assert isinstance(part, dict)
            part.pop("defaults", None)
            check({group: part}, ReconstructSettings if group == "views" else TrainSettings)


def test_the_plugin_of_the_page_works_with_its_own_command(
    root: Path, answer, registries: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The page's own code in its own file, its own command, in a folder that is on no path."""
    text = (root / "plugins" / "README.md").read_text()
    code = re.search(r"```python\n([^`]*register\(.doubled.\).*?)```", text, re.S)
    command = re.search(r"mvrecon-train (experiment=quickstart plugins=[^`\n]*)", text)
    assert code is not None and command is not None
    monkeypatch.delitem(sys.modules, "my_parts", raising=False)
    (tmp_path / "my_parts.py").write_text(code[1])
    with pytest.raises(ModuleNotFoundError, match="plugins=.my_parts. on the command line"):
        check_plugins(["my_parts"])

    def build(config) -> None:
        import_plugins(config.plugins)
        raise ValueError(PROJECTORS.origin(config.projector.name))

    answered = answer(*command[1].split(), task=build)
    assert answered == "mvrecon-train: ValueError: my_parts:doubled\n"


def test_an_error_in_a_plugin_names_its_innermost_line_and_how_to_see_the_traceback(
    answer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(registry, "_IMPORTED", set())
    file = tmp_path / "faulty_parts.py"
    file.write_text(
        "import json\n\nimport mvrecon\n\n\ndef inner(text):\n    return json.loads(text)\n\n\n"
        'def outer(text):\n    """Through the standard library."""\n    return inner(text)\n'
    )

    def run(config) -> None:
        import_plugins(config.plugins)
        sys.modules["faulty_parts"].outer("[")

    options = ("experiment=smoke", "plugins=[faulty_parts]")
    text = answer(*options, task=run)
    assert text.startswith("mvrecon-train: JSONDecodeError: Expecting value")
    assert text.endswith(f"; raised in {file}, line 7 (HYDRA_FULL_ERROR=1 shows the traceback)\n")
    monkeypatch.setattr(registry, "_IMPORTED", set())
    assert "raised in" not in answer("experiment=smoke", task=run)


def test_a_string_is_one_module():
    assert names("my_parts") == names(["my_parts"]) == ["my_parts"] and names(None) == []


def test_an_option_of_the_run_s_camera_can_be_set_directly(answer):
    def show(config) -> None:
        raise ValueError(f"{config.camera.n_views} {config.grid.spacing} {config.data.sizes.test}")

    options = ("camera.n_views=6", "+grid.spacing=2", "data.sizes.test=1")
    assert answer("checkpoint=x", *options, app="eval", task=show).endswith(": 6 2 1\n")
    text = answer("checkpoint=x", "grid.spacin=6", app="eval")
    assert "grid has no option 'spacin'; did you mean 'spacing'?" in text


def test_processes_of_one_run_need_a_shared_folder(answer, monkeypatch, tmp_path: Path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    for options, key in ((), "run"), (("--cfg", "job"), "run"), (("-m", "seed=0,1"), "sweep"):
        text = answer("experiment=smoke", *options)
        assert f"Expected hydra.{key}.dir=... for the 2 processes of one run" in text
    assert not list(tmp_path.iterdir())


def test_the_app_without_options_refuses_options_before_it_compiles(monkeypatch, capsys):
    monkeypatch.setattr(warmup, "warm_up", reached)
    with pytest.raises(SystemExit):
        warmup.main(["--all"])
    assert "unrecognized arguments: --all" in capsys.readouterr().err


def test_a_missing_run_is_an_error_in_one_line(tmp_path: Path, monkeypatch, capsys):
    """Of mvrecon-compare, and of mvrecon-eval before torch is imported."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit) as stop:
        compare.main([str(tmp_path / "nowhere")])
    text = capsys.readouterr().err
    assert stop.value.code == 1 and text.count("\n") == 1
    assert text.startswith("mvrecon-compare: FileNotFoundError: ")
    call = (
        "import atexit, sys, mvrecon.apps.eval as app; sys.argv = ['eval', 'checkpoint=nowhere'];"
        "atexit.register(lambda: print('torch' in sys.modules)); app.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", call], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1 and done.stdout == "False\n"
    assert re.fullmatch(r"mvrecon-eval: FileNotFoundError: No checkpoint .*nowhere\n", done.stderr)


def test_null_settings_are_refused_or_mean_none(answer):
    """Every setting with entries, as null or removed; `compare=null` compares with no method."""
    for options, message in {
        ("grid=null",): "grid: expected a mapping, got null",
        ("loss=null",): "loss: expected a mapping, got null",
        ("~trainer",): "These settings must be given: trainer=...",
        ("~method",): "These settings must be given: method=...",
        ("~seed",): "These settings must be given: seed=...",
        ("data.sizes=null",): "data.sizes: expected a mapping, got null",
        ("optimizer.name=null",): "optimizer.name: expected str, got null",
    }.items():
        assert message in answer(*options)
    settings = TrainSettings(**compose("experiment=smoke", "compare=null", "method=sirt"))
    assert settings.compare is None and list(settings.methods()) == ["sirt"]


def test_relative_paths_are_those_of_the_command_s_folder(answer, tmp_path: Path):
    """Also with `hydra.job.chdir=true`, in every app: the place that an error names is where the
    user has looked. Views and rig, a scene's file, a checkpoint, and a run to resume.
    """
    for app, line in {
        "reconstruct": "views.path=scan camera.path=rig.json",
        "simulate": "scene=volumes scene.path=scan",
        "eval": "checkpoint=scan",
        "train": "resume=scan",
    }.items():
        task = import_module(f"mvrecon.apps.{app}").task
        for chdir in ("true", "false"):
            text = answer(*line.split(), f"hydra.job.chdir={chdir}", task=task, app=app)
            assert re.search(rf"FileNotFoundError: .*{re.escape(str(tmp_path))}/scan\b", text), text


def test_a_file_in_the_place_of_a_folder_is_named_before_anything_is_made(answer, tmp_path: Path):
    """Of a run, of a sweep, of the cases that a training caches, or above one of them."""
    file, text = tmp_path / "file", f"NotADirectoryError: {tmp_path}/file: expected a folder"
    file.touch()
    simulate, train = (import_module(f"mvrecon.apps.{app}").task for app in ("simulate", "train"))
    for place in ("file", "file/run"):
        assert text in answer(f"hydra.run.dir={place}", task=simulate, app="simulate")
        sweep = ("-m", "seed=1,2", f"hydra.sweep.dir={place}")
        assert text in answer(*sweep, task=simulate, app="simulate")
        cached = ("experiment=smoke", f"data.cache={place}")
        for chdir in ("true", "false"):
            assert text in answer(*cached, f"hydra.job.chdir={chdir}", task=train)
    assert file.is_file() and [path for path in tmp_path.rglob("*") if path.is_file()] == [file]


@pytest.mark.parametrize(
    ("app", "work", "line"),
    [
        ("compare", "compare", ["run"]),
        ("list", "listed", ["--check"]),
        ("view", "view", ["a.nii.gz"]),
        ("warmup", "warm_up", []),
    ],
)
def test_ctrl_c_ends_an_app_in_one_line(app: str, work: str, line, monkeypatch, capsys):
    """Of the apps without Hydra, as of the others; also tried: SIGINT after 1 to 4 s of each."""

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    module = import_module(f"mvrecon.apps.{app}")
    monkeypatch.setattr(module, work, stop)
    with pytest.raises(SystemExit, match="130"):
        module.main(line)
    assert capsys.readouterr().err == f"mvrecon-{app}: stopped by Ctrl-C\n"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize(("sent", "status"), [("SIGTERM", "143"), ("SIGHUP", "129")])
def test_a_signal_ends_an_app_as_ctrl_c_does(sent, status, answer, monkeypatch, tmp_path):
    """A scheduler's or a closed terminal's: what is half written is removed, the status is that of
    a shell, and handlers of before are back. nohup's process goes on. Also tried: SIGINT, SIGTERM
    and SIGHUP at random moments of mvrecon-simulate and -reconstruct in processes of their own.
    """
    number, file = signal.Signals[sent], tmp_path / "volume.nii.gz"
    file.write_text("before")

    def stop(config: object) -> None:
        with written_whole(file) as part:
            part.write_text("half")
            signal.raise_signal(number)
            part.write_text("whole")

    usual = signal.signal(number, signal.SIG_DFL)
    try:
        assert answer(task=stop) == f"mvrecon-train: stopped by {sent}\n"
        assert signal.getsignal(number) is signal.SIG_DFL
        with pytest.raises(SystemExit, match=status), one_line("mvrecon-view"):
            signal.raise_signal(number)
        assert file.read_text() == "before" and not [*tmp_path.rglob("*.part")]
        signal.signal(number, signal.SIG_IGN)
        with one_line("mvrecon-view"):
            stop(None)
    finally:
        signal.signal(number, usual)
    assert file.read_text() == "whole"


def test_a_refused_command_leaves_no_folder(answer, tmp_path: Path):
    """Values that only a task refuses, of every app: labels that are paths, too long, empty but for
    dots, taken or unprintable; pictures, units, missing files. A folder of the user's stays.
    """
    (tmp_path / "mine").mkdir()
    refused = {
        "train": {
            "label=a/b": "label: ",
            "label='..'": "label: ",
            "label=truth": "label",
            f"label={'a' * 201}": "label: ",
            "label='a\tb'": "label: ",
            "label=sirt": "label",
            "+compare.'a/b'={name: sirt}": "a/b",
            "data.sizes.test=0": "data.sizes.test",
            "init_from=nowhere": "nowhere",
            "resume=nowhere": "resume",
            "trainer.strategy=fsdp": "strategy",
            "trainer=bf16 device=cpu": "trainer.precision=bf16-mixed on a CPU",
        },
        "simulate": {"picture=x": "picture", "scene=volumes scene.path=nowhere": "nowhere"},
        "reconstruct": {"calibrate=[sped]": "/x", "views.path=nowhere": "nowhere"},
        "eval": {"checkpoint=elsewhere": "elsewhere", "checkpoint=nowhere": "nowhere"},
    }
    given = {
        "train": ["experiment=smoke"],
        "simulate": [],
        "reconstruct": ["views.path=x", "camera.path=x"],
        "eval": ["checkpoint=x"],
    }
    places = cycle([[], ["hydra.run.dir=mine"], ["hydra.run.dir=new/run"]])
    for app, lines in refused.items():
        task = import_module(f"mvrecon.apps.{app}").task
        for line, named in lines.items():
            options = [line] if line.startswith(("label", "+")) else line.split(" ")
            options += next(places)
            text = answer(*given[app], *options, task=task, app=app)
            assert text.count("\n") == 1 and named in text, text
            assert [path.name for path in tmp_path.rglob("*")] == ["mine"], options
