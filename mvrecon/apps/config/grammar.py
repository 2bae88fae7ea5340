"""A user's command line in Hydra's grammar.

Hydra takes ASCII letters, digits and some signs without quotes. A path or a name may have any
characters, so a value that Hydra refuses is quoted, alone or within a list, a mapping or a sweep;
what Hydra's grammar has a meaning for keeps it: lists, mappings, sweeps, numbers, null and
interpolations.
"""

import re
import warnings
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString, ValueType
from hydra.errors import HydraException

from mvrecon.apps.settings import SECTIONS
from mvrecon.core.files.checks import file_in
from mvrecon.core.machine import world
from mvrecon.core.parts import LISTED, describe, describe_section
from mvrecon.core.signatures import alternatives

#: What a path with a meaning in Hydra's grammar has in it, as that of a sweep's run.
GRAMMAR_CHARACTERS = set("=,;()[]{}' ")
#: Hydra's own settings that are texts.
HYDRA_TEXTS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir", "hydra.job.name")
#: Arguments that ask for a sweep.
MULTIRUN = {"-m", "--multirun", "hydra.mode=MULTIRUN"}
#: Texts in quotes, or single characters.
TOKENS = re.compile(r"""'(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|.""", re.DOTALL)


@dataclass(frozen=True)
class CommandLine:
    """What a user typed for Hydra.

    Args:
        flags: flags of Hydra, such as `--cfg` and `job`.
        overrides: changes in Hydra's grammar, without folders of configs.
        folders: folders of configs from elsewhere.
    """

    flags: list[str]
    overrides: list[str]
    folders: list[str]

    @classmethod
    def of(
        cls,
        arguments: Sequence[str],
        sections: Collection[str] = (),
        names: Collection[str] = (),
        tables: Collection[str] = (),
    ) -> "CommandLine":
        """Split arguments; `--config-dir` becomes an entry of `hydra.searchpath`, and texts are
        quoted where Hydra's grammar needs it.

        Args:
            arguments: the words as typed.
            sections: sections of settings whose options are set whether the app's own file has them
                or not, as by Hydra's ++.
            names: names of settings that are texts.
            tables: sections with entries by name, of which one that is there may become null.

        Raises:
            PermissionError: a flag that chooses configs of other apps, or that unpickles a file.
        """
        flags, overrides, folders, rest = [], [], [], iter(arguments)
        sweeps = bool(MULTIRUN & set(arguments))
        for argument in rest:
            key, sign, value = argument.partition("=")
            if key in ("--config-dir", "-cd"):
                folders.append(str(Path(value if sign else next(rest, "")).absolute()))
            elif argument.startswith("--e"):
                raise PermissionError(
                    "--experimental-rerun unpickles a file, which can run anything; use "
                    "resume=<run folder>"
                )
            elif argument.startswith(("--co", "-cd", "-cp", "-cn")):
                raise PermissionError(
                    f"{argument}: --config-path and --config-name of other apps are not allowed; "
                    f"use --config-dir=..."
                )
            elif argument.startswith("-") or not (sign or argument.startswith("~")):
                flags.append(argument)
            elif key == "hydra.searchpath":
                line = f"{key}={in_grammar(key, value)}"
                paths: Any = OverridesParser.create().parse_override(line).value() or []
                packages = [path for path in paths if path.startswith("pkg://")]
                folders += [path.removeprefix("file://") for path in paths if path not in packages]
                if packages:
                    overrides.append(f"{key}={quoted(packages)}")
            else:
                section, dot, entry = key.partition(".")
                within = section in sections and (dot or value[:1] == "{")
                if section in tables and "." not in entry and value == "null":
                    within = False
                text = in_grammar(key.lstrip("+~"), value, names, sweeps) if sign else ""
                overrides.append(f"{'++' if within else ''}{key}{sign}{text}")
        return cls(flags, overrides, folders)

    def check_shared_folder(self) -> None:
        """Check that the processes of one run have a folder to share.

        Raises:
            ValueError: they do not, and each would make its own.
        """
        key = "hydra.sweep.dir=" if self.sweeps else "hydra.run.dir="
        named = any(line.startswith((key, "resume=")) for line in self.overrides)
        if world() > 1 and not named:
            raise ValueError(
                f"Expected {key}... for the {world()} processes of one run, which share it"
            )

    @property
    def fixed(self) -> list[str]:
        """The overrides that a sweep does not vary."""
        typed = OverridesParser.create().parse_overrides(self.overrides)
        return [o.input_line or "" for o in typed if not o.is_sweep_override()]

    @property
    def jobs(self) -> list[list[str]]:
        """The overrides of some of a sweep's jobs, in which each of its listed values occurs."""
        typed = OverridesParser.create().parse_overrides(self.overrides)
        varied = {
            o.get_key_element(): list(o.sweep_string_iterator())
            for o in typed
            if o.is_discrete_sweep()
        }
        first = {key: values[0] for key, values in varied.items()}
        jobs = [{**first, key: value} for key, values in varied.items() for value in values]
        return [
            self.fixed + [f"{key}={value}" for key, value in job.items()] for job in jobs or [first]
        ]

    @property
    def sweeps(self) -> bool:
        """Whether an argument asks for a sweep."""
        return not MULTIRUN.isdisjoint([*self.flags, *self.overrides])


def quoted(value: str | Sequence[str]) -> str:
    """A text, or a list of texts, in quotes."""
    if not isinstance(value, str):
        return f"[{','.join(map(quoted, value))}]"
    return QuotedString(value, Quote.single).with_quotes()


def as_text(value: str) -> str:
    """A text as it is, or in quotes where Hydra would read another, a number or null."""
    override = _override(value)
    same = override and not override.is_sweep_override() and override.value() == value
    return value if same else quoted(value)


def in_grammar(key: str, value: str, names: Collection[str] = (), sweeps: bool = False) -> str:
    """A typed value in Hydra's grammar.

    Args:
        key: name of the setting.
        value: the value as typed; the path of an existing file, or of a data set in one, is one
            text, whatever is in its name.
        names: settings of the app that are texts, also where a number is typed.
        sweeps: whether commas separate the values of a sweep.

    Warns:
        UserWarning: a number that is also the name of a file, of an option that takes both.
    """
    if _exists(value) and GRAMMAR_CHARACTERS & set(value):
        return quoted(value)
    mended = _mended(value, sweeps)
    override, is_name = _override(mended), key in (*names, *HYDRA_TEXTS)
    if override is None:  # brackets that do not close
        return quoted(value) if is_name or _is_text(key) else value
    if override.value_type is ValueType.SIMPLE_CHOICE_SWEEP and not sweeps:
        return quoted(value) if is_name or _is_text(key) else mended
    plain = None if override.is_sweep_override() else override.value()
    if plain is None or isinstance(plain, str):
        return mended
    if is_name:
        return quoted(value)
    if _exists(value) and _is_text(key):
        kinds = {bool} if isinstance(plain, bool) else {int, float}
        if not (numbers := [members for members in _members(key) if kinds & members]):
            return quoted(value)
        if any(Path in members for members in numbers):
            warnings.warn(
                f"{key}={value} is taken for a number, not for what is here by this name; "
                f"{key}=./{value} is that",
                stacklevel=2,
            )
    return mended


def _override(value: str) -> Override | None:
    """What Hydra reads from a value; None where it refuses it."""
    with suppress(HydraException):
        return OverridesParser.create().parse_override(f"key={value}")
    return None


def _mended(value: str, sweeps: bool = False) -> str:
    """A value with quotes around each text that Hydra refuses."""
    value = value.strip(" \t")  # as Hydra
    if _override(value):
        return value
    parts, closed = _parts(value)
    if not closed and value[:1] in "[{" or re.search(r"\$\{[^}]*$", value):
        return value
    if sweeps and len(parts) > 1:
        return ",".join(map(_mended, parts))
    if len(parts) == 1 and (value[0] + value[-1]) in ("[]", "{}"):
        entries, _ = _parts(value[1:-1])
        if value[0] == "[":
            return f"[{','.join(map(_mended, entries))}]"
        pairs = (entry.partition(":") for entry in entries)
        return "{" + ",".join(f"{key}{colon}{_mended(v)}" for key, colon, v in pairs) + "}"
    return quoted(value)


def _parts(text: str) -> tuple[list[str], bool]:
    """The texts between commas that are in no brackets and no quotes; whether brackets close."""
    depth, parts = 0, [""]
    for token in TOKENS.findall(text):
        depth += (token in list("([{")) - (token in list(")]}"))
        if token == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += token
    return parts, depth == 0


def _exists(value: str) -> bool:
    """Whether a value is the path of a file or folder, or of a data set in a file."""
    try:
        return file_in(Path.cwd(), value) is not None
    except (OSError, ValueError, RuntimeError):  # too long for a path; no such user
        return False


def _is_text(key: str) -> bool:
    """Whether an option of a part or section with this name is a text or a path."""
    return any({str, Path} & members for members in _members(key))


def _members(key: str) -> list[set[Any]]:
    """The types of all options of parts and sections with this name."""
    return _types().get(key.rpartition(".")[2], []) if "." in key else []


@cache
def _types() -> dict[str, list[set[Any]]]:
    """The types of all options of all parts and sections, by name; imports them all."""
    parts = [describe(kind, name).options for kind in LISTED for name in LISTED[kind].names()]
    sections = [describe_section(name, section).options for name, section in SECTIONS.items()]
    found: dict[str, list[set[Any]]] = {}
    for options in (*parts, *sections):
        for name, option in options.items():
            members = {m for m, _ in alternatives(option.type) if isinstance(m, type)}
            found.setdefault(name, []).append(members)
    return found
