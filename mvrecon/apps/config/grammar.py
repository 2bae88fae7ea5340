"""Texts in the grammar of Hydra's command line.

Hydra takes ASCII letters, digits and some signs without quotes. A path or a name may have any
characters, so a value that Hydra refuses is quoted, alone or within a list, a mapping or a sweep;
what Hydra's grammar has a meaning for keeps it: lists, mappings, sweeps, numbers, null and
interpolations.
"""

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString, ValueType
from hydra.errors import HydraException

from mvrecon.core.parts import LISTED
from mvrecon.core.quantities import RANGES
from mvrecon.core.signatures import SECTIONS, describe, options_of

#: What a path with a meaning in Hydra's grammar has in it, as that of a sweep's run.
SIGNS = set("=,;()[]{}' ")
#: Hydra's own settings that are texts.
OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir", "hydra.job.name")
#: Types of paths, and of numbers.
PATHS, NUMBERS = {"Path", "WeightsFile"}, {"int", "float", "bool", *RANGES}
#: Texts in quotes, or single characters.
TOKENS = re.compile(r"""'(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|.""", re.DOTALL)


def quoted(value: str | Sequence[str]) -> str:
    """A text, or a list of texts, in quotes."""
    if not isinstance(value, str):
        return f"[{','.join(map(quoted, value))}]"
    return QuotedString(value, Quote.single).with_quotes()


def in_grammar(key: str, value: str, names: Collection[str] = (), sweeps: bool = False) -> str:
    """A typed value in Hydra's grammar.

    Args:
        key: of the setting.
        value: as typed; an existing path is one text, whatever is in its name.
        names: settings of the app that are texts, also where a number is typed.
        sweeps: whether commas separate the values of a sweep.
    """
    if _exists(value) and SIGNS & set(value):
        return quoted(value)
    mended = _mended(value, sweeps)
    override, is_name = _override(mended), key in (*names, *OF_HYDRA)
    if override is None:  # brackets that do not close
        return quoted(value) if is_name or _path_types(key) else value
    if override.value_type is ValueType.SIMPLE_CHOICE_SWEEP and not sweeps:
        return quoted(value) if is_name or _path_types(key) else mended
    plain = None if override.is_sweep_override() else override.value()
    if plain is None or isinstance(plain, str):
        return mended
    if is_name:
        return quoted(value)
    types = _path_types(key) if _exists(value) else []
    is_path = types and not any(NUMBERS & set(type.split(" | ")) for type in types)
    return quoted(value) if is_path else mended


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
    try:
        return Path(value).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # too long for a path; no such user
        return False


def _path_types(key: str) -> list[str]:
    """The types of a part's option with this name, if any of them is a path."""
    types = _types().get(key.rpartition(".")[2], []) if "." in key else []
    return types if any(PATHS & set(type.split(" | ")) for type in types) else []


@cache
def _types() -> dict[str, list[str]]:
    """The types of all options of all parts, by name."""
    parts = [describe(kind, name).options for kind in LISTED for name in LISTED[kind].names()]
    found: dict[str, list[str]] = {}
    for options in (*parts, *map(options_of, SECTIONS)):
        for name, option in options.items():
            found.setdefault(name, []).append(option.type)
    return found
