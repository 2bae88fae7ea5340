"""`--help` of every command, of plugins as well: what it does, examples that are valid, then the
options in sentences, and where the documentation is.
"""

import importlib
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

import mvrecon
from mvrecon.apps.command_line import DOCUMENTATION
from mvrecon.apps.config import compose
from mvrecon.apps.settings import RECORDS
from mvrecon.core import options as core_options

ROOT = Path(__file__).parents[2]
PROJECTS = [ROOT / "pyproject.toml", *sorted(ROOT.glob("plugins/*/pyproject.toml"))]
#: The module of each command.
COMMANDS = {
    command: place.partition(":")[0]
    for file in PROJECTS
    for command, place in tomllib.loads(file.read_text())["project"].get("scripts", {}).items()
}
#: What the options of a command stand under.
OPTIONS = re.compile(r"^(?:positional arguments|options|Choices|Settings)\b.*:$", re.M)
#: An option with its text, of argparse and of ours, whose text is always below it.
ARGPARSE = re.compile(r"^  (\S.*?)(?:  +|\n {10,})(\S.*(?:\n {10,}.*)*)", re.M)
OURS = re.compile(r"^  ([\w@]+)(?:=.*)?\n((?: {6}.*\n)*)", re.M)


def said(command: str, flag: str, monkeypatch, capsys) -> str:
    """What a command prints by this flag alone."""
    pytest.importorskip(COMMANDS[command].partition(".")[0])  # a plugin that is not installed
    monkeypatch.setattr(sys, "argv", [command, flag])
    monkeypatch.setenv("COLUMNS", "100")
    try:
        importlib.import_module(COMMANDS[command]).main()
    except SystemExit as end:
        assert not end.code
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_begins_with_examples_and_ends_with_the_documentation(
    command: str, monkeypatch, capsys
):
    text = said(command, "--help", monkeypatch, capsys)
    assert text.endswith(f"\n{DOCUMENTATION}") and text.count(DOCUMENTATION) == 1
    start = OPTIONS.search(text)
    assert start is not None
    head, rest = text[: start.start()], text[start.start() :].removesuffix(DOCUMENTATION)
    examples = re.findall(rf"^ +(?:[A-Z_]+=\S+ )?{command}\b(.*)", head, re.M)
    assert len(examples) >= 2 and head.count("Examples:") == 1
    module, app = importlib.import_module(COMMANDS[command]), command.removeprefix("mvrecon-")
    for words in map(shlex.split, examples):
        if hasattr(module, "parser"):
            module.parser().parse_args([w for w in words if not w.startswith("plugins=")])
        else:
            settings = compose(*words, config_name=app)
            if app in RECORDS:
                core_options.check(settings, RECORDS[app])
    entries = (ARGPARSE if hasattr(module, "parser") else OURS).findall(rest)
    assert len(entries) >= 2  # also that of mvrecon-warmup: --help and --version
    for option, words in entries:
        sentences = " ".join(words.partition("Choices: ")[0].split())
        assert re.fullmatch(r"\S.*\.", sentences), option


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_tells_its_version(command: str, monkeypatch, capsys):
    text = said(command, "--version", monkeypatch, capsys)
    assert text == f"mvrecon {mvrecon.__version__}\n"
