"""The project that `mvrecon-list --new-plugin` writes keeps the contract of every kind of part."""

import importlib.util
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from mvrecon.apps.config import check_settings, compose
from mvrecon.apps.list import main, new_plugin
from mvrecon.apps.settings import TrainSettings
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.registry import GROUP
from tests.faults.plugins import plugin

NAME = "seven_kinds"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory):
    """The project on Python's path, declared as pip would."""
    folder = tmp_path_factory.mktemp("projects")
    new_plugin(NAME, folder)
    about = tomllib.loads((folder / NAME / "pyproject.toml").read_text())["project"]
    with plugin(folder / NAME, about["entry-points"][GROUP], name=NAME):
        spec = importlib.util.spec_from_file_location(
            "seven_kinds_tests", folder / NAME / "tests" / "test_parts.py"
        )
        assert spec is not None and spec.loader is not None
        tests = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(tests)
        yield folder / NAME, tests
    for module in [m for m in sys.modules if m.partition(".")[0] == NAME]:
        del sys.modules[module]


KINDS = ["scene", "camera", "projector", "head", "weighting", "network", "method"]
#: The settings that choose the project's parts.
CHOICES = {
    *(f"{kind}={NAME}" for kind in ("scene", "camera", "projector", "method")),
    *(f"method.{part}={NAME}" for part in ("head", "weighting", "network.name")),
    f"method={NAME}_solver",
}


@pytest.mark.parametrize("part", [*KINDS, "solver"])
def test_a_part_of_the_project_passes_its_own_test(part: str, project):
    _, tests = project
    getattr(tests, f"test_{part}")()


def test_the_commands_of_the_project_compose(project):
    folder, _ = project
    lines = (folder / "README.md").read_text().splitlines()
    commands = [shlex.split(line) for line in lines if line.startswith("    mvrecon-train")]
    assert CHOICES <= {word for command in commands for word in command}
    for _, *overrides in commands:
        check_settings(OmegaConf.create(compose(*overrides)), TrainSettings)


def test_the_project_registers_every_part_with_its_file(project):
    folder, tests = project
    for kind in KINDS:
        assert NAME in REGISTRIES[kind].names()
    assert f"{NAME}_solver" in REGISTRIES["method"].names()
    files = {f"{file.parent.name}/{file.stem}" for file in tests.CONF}
    assert files == {*(f"{kind}/{NAME}" for kind in KINDS), f"method/{NAME}_solver"}
    for file in tests.CONF:
        tests.test_a_file_names_a_part_and_options_that_it_has(file)


def test_the_project_follows_the_style_of_mvrecon(project, root: Path):
    folder, _ = project
    command = [sys.executable, "-m", "ruff"]
    for act in (["check"], ["format", "--check"]):
        options = [*act, "--no-cache", f"--config={root / 'pyproject.toml'}", str(folder)]
        # from the project's folder: there mvrecon is a library like any other
        done = subprocess.run(
            [*command, *options], cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout
    assert not [file for file in folder.rglob("*") if "my_plugin" in file.name]


def test_an_invalid_or_taken_name_is_refused(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--new-plugin", "mine"]) == 0
    assert "pip install -e mine" in capsys.readouterr().out
    before = sorted(tmp_path.rglob("*"))
    for name, why in {
        "mine": "exists",
        "a-b": "a Python package",
        "mvrecon_x": "not begin",
    }.items():
        with pytest.raises(SystemExit):
            main(["--new-plugin", name])
        assert why in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
