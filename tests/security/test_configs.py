"""A config is a list of names and numbers: whatever it says, nothing runs, nothing is written, nothing is read."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from mvrecon.config import compose, import_plugins, instantiate
from mvrecon.limits import Refused, yaml_of


class Payload:
    """Unpickling it makes a file."""

    def __init__(self, command: str):
        self.command = command

    def __reduce__(self):
        import os

        return os.system, (self.command,)


@pytest.fixture
def sentinel(tmp_path: Path) -> Path:
    """A file that only a hostile sample makes."""
    return tmp_path / "sentinel"


def targets(sentinel: Path) -> dict[str, dict]:
    """Nodes that would make the sentinel if they were built."""
    touch = f"touch {sentinel}"
    pickled = sentinel.with_name("payload.ckpt")
    timer = {"_target_": "lightning.pytorch.callbacks.Timer"}
    call = "lightning.pytorch.cli.instantiate_class"
    load = "lightning.pytorch.LightningModule.load_from_checkpoint"
    return {
        "direct": {"_target_": "os.system", "command": touch},
        "builtin": {"_target_": "builtins.eval", "source": f"open({str(sentinel)!r}, 'w')"},
        "through a module's import": {"_target_": "lightning.pytorch.trainer.trainer.os.system", "command": touch},
        "through another package": {"_target_": "logging.os.system", "command": touch},
        "a function that calls": {"_target_": call, "args": touch, "init": {"class_path": "os.system"}},
        "a function that writes": {"_target_": "mvrecon.engine.record.write", "path": str(sentinel), "text": "x"},
        "a method that unpickles": {"_target_": load, "checkpoint_path": str(pickled), "weights_only": False},
        "a class of another kind": {"_target_": "lightning.pytorch.Trainer", "default_root_dir": str(sentinel)},
        "nested": {**timer, "duration": {"_target_": "os.system", "command": touch}},
        "nested in a list": {**timer, "duration": [{"_target_": "os.system", "command": touch}]},
        "partial": {**timer, "_partial_": True},
        "positional": {**timer, "_args_": [touch]},
        "not a name": {"_target_": ["os.system"], "command": touch},
    }


@pytest.mark.parametrize("name", sorted(targets(Path("sentinel"))))
def test_a_target_is_a_callback_or_a_logger_or_refused(name: str, sentinel: Path):
    torch.save(Payload(f"touch {sentinel}"), sentinel.with_name("payload.ckpt"))
    with pytest.raises(PermissionError, match="not allowed; expected"):
        instantiate(targets(sentinel)[name])
    assert not sentinel.exists()


def test_an_alias_or_a_reference_to_a_target_is_what_it_names(sentinel: Path, folder):
    text = f"""
optimizer: {{a: &t os.system, b: touch {sentinel}}}
callbacks:
  by_alias: {{_target_: *t, command: touch {sentinel}}}
  by_reference: {{_target_: "${{optimizer.a}}", command: touch {sentinel}}}"""
    settings = compose(*folder(text))
    for name in ("by_alias", "by_reference"):
        assert settings["callbacks"][name]["_target_"] == "os.system"
        with pytest.raises(PermissionError, match="'os.system' is not allowed"):
            instantiate(settings["callbacks"][name])
    assert not sentinel.exists()


@pytest.fixture
def folder(tmp_path: Path):
    """An experiment in a folder that was fetched from somewhere; returns the overrides that choose it."""

    def write(text: str, **files: str) -> list[str]:
        for name, content in {"experiment/evil.yaml": f"# @package _global_\n{text}\n", **files}.items():
            (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
            (tmp_path / name).write_text(content)
        return [f"hydra.searchpath=[file://{tmp_path}]", "experiment=evil"]

    return write


def nasty(sentinel: Path) -> dict[str, str]:
    """Experiments that tell Hydra itself what to do; each made the sentinel, or opened a way to, before the guard."""
    touch, call = f'"touch {sentinel}"', "lightning.pytorch.cli.instantiate_class"
    evil = f"{{_target_: {call}, args: {touch}, init: {{class_path: os.system}}}}"
    handler = f"{{class: {call}, args: {touch}, init: {{class_path: os.system}}}}"
    return {
        "a callback": f"hydra: {{callbacks: {{evil: {evil}}}}}",
        "a log handler": f"hydra: {{job_logging: {{handlers: {{file: {handler}}}}}}}",
        "a log file": f"hydra: {{job_logging: {{handlers: {{file: {{filename: {sentinel}}}}}}}}}",
        "a library's folder": "hydra: {job: {env_set: {HDF5_PLUGIN_PATH: .}}}",
        "a launcher": "hydra: {launcher: {_target_: os.system}}",
        "a folder": f"hydra: {{run: {{dir: {sentinel}}}}}",
        "another choice": "defaults: [override /hydra/job_logging: none]",
    }


@pytest.mark.parametrize("name", sorted(nasty(Path("sentinel"))))
def test_a_fetched_experiment_tells_hydra_nothing(name: str, sentinel: Path, folder):
    with pytest.raises(PermissionError, match=r"A config sets \['hydra\..*only a command line may"):
        compose(*folder(nasty(sentinel)[name]))


def test_the_app_refuses_before_hydra_acts(sentinel: Path, folder, root: Path, tmp_path: Path):
    folder(nasty(sentinel)["a callback"])
    command = [sys.executable, "-m", "mvrecon.simulate", f"--config-dir={tmp_path}", "+experiment=evil", "cases=[0]"]
    command += [f"hydra.run.dir={tmp_path}/out"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "only a command line may" in done.stderr
    assert not sentinel.exists() and not (tmp_path / "out").exists()


def test_what_an_experiment_may_say_of_hydra_still_composes(folder):
    settings = compose(*folder("name: mine\nhydra: {sweeper: {params: {seed: '0,1'}}}"), "hydra.verbose=true")
    assert settings["name"] == "mine"


def test_configs_of_hydras_own_in_a_fetched_folder_are_refused(folder):
    chosen = folder("name: mine", **{"hydra/launcher/evil.yaml": "_target_: os.system"})
    with pytest.raises(PermissionError, match="configs of Hydra's own"):
        compose(*chosen, "hydra/launcher=evil")


def test_environment_variables_are_not_read(folder, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SECRET", "s3cret")
    with pytest.raises(PermissionError, match="environment variables"):
        compose(*folder("name: ${oc.env:SECRET}"))
    assert compose("name=${oc.env:SECRET}")["name"] == "s3cret"  # the user's own word


@pytest.mark.parametrize("name", ["../../out", "/etc/out", "a/../../b", "..", "a\\..\\b", "a\nb"])
def test_a_name_does_not_lead_out_of_the_outputs(name: str, folder):
    with pytest.raises(Refused, match="has the name"):
        compose(*folder(f"name: {name!r}"))


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10)
)


def test_a_yaml_file_that_unfolds_is_refused_at_once(folder, tmp_path: Path):
    with pytest.raises(Refused, match=r"evil\.yaml: unfolds to more than"):
        compose(*folder(BOMB))
    path = tmp_path / "bomb.yaml"
    for text, message in [(BOMB, "unfolds"), ("a: &a [*a]", "unfolds"), ("x: " + "[" * 10_000, "is not YAML")]:
        path.write_text(text)
        with pytest.raises(Refused, match=rf"bomb\.yaml: {message}"):
            yaml_of(path)


def test_yaml_tags_build_nothing(sentinel: Path, folder):
    for tag in (f'!!python/object/apply:os.system ["touch {sentinel}"]', "!!python/name:os.system"):
        with pytest.raises(Exception, match="could not determine a constructor|is not YAML"):
            compose(*folder(f"name: {tag}"))
    assert not sentinel.exists()


@pytest.mark.parametrize(
    "module", ["os", "antigravity", "lightning.pytorch.cli", "no_such_module", "evil", "a b", ".x"]
)
def test_a_setting_imports_only_what_was_written_for_mvrecon(module: str, tmp_path: Path, monkeypatch, sentinel: Path):
    (tmp_path / "evil.py").write_text(f"open({str(sentinel)!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(PermissionError, match="expected a module on Python's path whose own source imports mvrecon"):
        import_plugins([module])
    assert not sentinel.exists()


def test_a_pickled_config_is_not_run_again(run_python):
    done = run_python(
        "-c", "import sys; sys.argv = ['x', '--experimental-rerun=a.pickle']; import mvrecon.train as t; t.main()"
    )
    assert done.returncode == 1 and "unpickles a file" in done.stderr
