"""Choices of the command line: config groups with their files, which groups an app takes, and
checks of what is chosen, before Hydra composes it.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from mvrecon.core.files.checks import shown, yaml_of
from mvrecon.core.options import check_value, fits, part_of
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.registry import hint, installed, locate
from mvrecon.core.signatures import Option, options_of

#: Groups whose part is an option of a method.
METHOD_GROUPS = {"head", "weighting", "network"}


def conf_dir() -> Path:
    """The folder of YAML files: in the package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[2]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def trusted_folders() -> list[Path]:
    """Config folders: mvrecon's own, then those of installed plugins (entry points "conf.*")."""
    packages = (locate(point.value) for point in installed() if point.name.startswith("conf."))
    found = (package.submodule_search_locations or () for package in packages if package)
    return [conf_dir(), *(Path(folder) for folders in found for folder in folders)]


def choice_file(place: str) -> Path | None:
    """The file of a choice, such as "scene/hdf5", or of an app's settings, in a trusted folder."""
    files = (folder / f"{place}.yaml" for folder in trusted_folders())
    return next((file for file in files if file.is_file()), None)


def app_file(app: str) -> Path:
    """The YAML file of an app's choices.

    Raises:
        FileNotFoundError: no app has such a file.
    """
    if (file := choice_file(app)) is not None:
        return file
    folders = [str(folder) for folder in trusted_folders()]
    raise FileNotFoundError(f"No app has the settings {app}.yaml in any of {shown(folders)}")


def groups() -> set[str]:
    """All config groups but Hydra's own."""
    found = {
        path.name for folder in trusted_folders() for path in folder.iterdir() if path.is_dir()
    }
    return {name for name in found if name.isidentifier()} - {"hydra"} | {*REGISTRIES}


def groups_of(app: str) -> dict[str, str | None]:
    """The config groups in an app's defaults list by the setting that they fill, and those of its
    methods, with their choices.
    """
    entries = (e for e in yaml_of(app_file(app)).get("defaults", ()) if isinstance(e, dict))
    pairs = (pair for entry in entries for pair in entry.items())
    found = {re.sub("^override ", "", key).strip("/"): choice for key, choice in pairs}
    return found | (dict.fromkeys(METHOD_GROUPS) if "method" in found else {})


def check_choices(overrides: Sequence[Override], app: str, record: type | None) -> list[str]:
    """Check what a command line chooses, and the settings that it gives as a whole; returns it for
    Hydra, which has no choice of none.

    Raises:
        LookupError: a group, or an experiment, of another app.
        TypeError: a value of another type.
    """
    taken, known, lines = groups_of(app), groups(), []
    options = options_of(record)[0] if record else {}
    typed = {o.key_or_group: o for o in overrides if o.package is None and not o.is_delete()}
    for override in overrides:
        key, line = override.key_or_group, override.input_line or ""
        if override is not typed.get(key):
            lines.append(line)
            continue
        if key in METHOD_GROUPS and "method" in taken:
            raise LookupError(f"{key!r} is a part of a method; to choose it: method.{key}=...")
        if key in known - {*taken, *options} and not override.is_add():
            raise LookupError(f"This app chooses no {key!r}; --help shows what it chooses")
        values = _values(override)
        for value in values:
            if key in taken and not isinstance(value, dict):  # a mapping is its settings
                needed = taken[key] is not None and not fits(None, options.get(key, Option()).type)
                names = value if isinstance(value, list) else [value]
                check_single(key, value, options.get(key, Option()))
                if not all(
                    (isinstance(name, str) and name) or (name is None and not needed)
                    for name in names
                ):
                    raise TypeError(
                        f"{key}: expected one of {', '.join(choices_by_group()[key])}, got "
                        f"{'null' if value is None else shown(value)}"
                    )
                if key == "experiment" and value is not None:
                    check_experiment(str(value), app, record, typed)
            elif key in options:
                check_value(key, value, options[key])
        if key not in {*taken, *known} or values != [None]:
            lines.append(line)
        elif taken.get(key) is not None:
            lines.append(f"~{key}")
    return lines


def check_single(key: str, value: Any, option: Option) -> None:
    """Check that one choice is made of a part or an experiment, of which the last would win.

    Raises:
        TypeError: a list.
    """
    if isinstance(value, list) and (key == "experiment" or part_of(option.type)):
        raise TypeError(f"{key}: expected one choice, got {shown(value)}")


def _values(override: Override) -> list[Any]:
    """The values of an override, several of a sweep."""
    if override.is_discrete_sweep():
        lines = [f"x={value}" for value in override.sweep_string_iterator()]
        return [one.value() for one in OverridesParser.create().parse_overrides(lines)]
    return [] if override.is_sweep_override() else [override.value()]


def check_experiment(
    name: str, app: str, record: type | None, typed: Mapping[str, Override]
) -> None:
    """Check that an experiment is of an app, and that what the command line chooses fits it; that
    it exists is for Hydra to say.

    Raises:
        LookupError: an experiment that chooses or sets what the app does not have, or a method for
            the place of one around another.
    """
    file = choice_file(f"experiment/{name}")
    stored = ConfigStore.instance().repo.get("experiment", {}).get(f"{name}.yaml")
    if file is None and stored is None:
        return
    values: Any = yaml_of(file) if file else OmegaConf.to_container(stored.node, resolve=False)
    own = {
        re.sub("^override ", "", str(k)): v
        for e in values.get("defaults", ())
        if isinstance(e, dict)
        for k, v in e.items()
    }
    place, taken = f"experiment/{name}", {key.partition("@")[0] for key in groups_of(app)}
    known = {setting.name for setting in fields(record)} if record else set(values)
    options = options_of(record)[0] if record else {}
    for key, choice in own.items():
        check_single(key.strip("/"), choice, options.get(key.strip("/"), Option()))
        group, _, package = key.strip("/").partition("@")
        if group not in taken and package.partition(".")[0] not in known:
            raise LookupError(
                f"{place} is for another app: it chooses {group!r}, which is not here"
            )
        outer = package.partition(".")[0]
        if (
            "." in package
            and outer in {*taken} & {*typed}
            and typed[outer].value() != own.get(f"/{outer}")
        ):
            raise LookupError(
                f"{place} has {outer} around another method; to choose that: {key.strip('/')}=..."
            )
    if unused := [key for key in values if key not in known | {"defaults", "hydra"}]:
        raise LookupError(
            f"{place} sets {unused[0]!r}, which is no setting of this app{hint(unused[0], known)}"
        )


def files_by_group() -> dict[str, set[str]]:
    """The names of the files in trusted folders by group."""
    found: dict[str, set[str]] = {}
    for folder in trusted_folders():
        for file in folder.glob("*/*.yaml"):
            found.setdefault(file.parent.name, set()).add(file.stem)
    return found


def choices_by_group() -> dict[str, list[str]]:
    """The names of all choices by group."""
    found = files_by_group()
    for kind, _, name in (point.name.partition(".") for point in installed()):
        if kind in REGISTRIES:
            found.setdefault(kind, set()).add(name)
    return {group: sorted(names) for group, names in sorted(found.items())}
