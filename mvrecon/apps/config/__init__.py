"""Settings of the apps: composed by Hydra to plain dicts, and checked by the types of their record.

Importing this file imports neither torch nor Lightning; a check imports the parts that it checks.
"""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import MISSING as NO_DEFAULT, fields, replace
from functools import cache, wraps
from io import TextIOWrapper
from pathlib import Path, PurePosixPath
from types import NoneType
from typing import Any

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from mvrecon import __version__
from mvrecon.apps.config import guard
from mvrecon.apps.config.errors import METHOD_GROUPS, one_line, reported
from mvrecon.apps.config.grammar import CommandLine
from mvrecon.apps.settings import MISSING, RECORDS
from mvrecon.core.files.checks import shown, yaml_of
from mvrecon.core.files.runs import of_weights
from mvrecon.core.machine import silence_libraries
from mvrecon.core.options import (
    Option,
    alternatives,
    check,
    check_given,
    check_value,
    fits,
    is_section,
    options_of,
    with_paths,
)
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.registry import hint, import_plugins, installed, locate

#: Loggers of conf/logger that need a package, which the extra of the same name installs.
LOGGER_EXTRAS = {"wandb", "mlflow"}
#: Types of settings that are texts.
TEXT_TYPES = {str, Path, NoneType}
#: A reference to another setting.
REFERENCE = re.compile(r"\$\{([\w.@]+)\}")


class PluginConf(SearchPathPlugin):
    """Adds the config folders of installed plugins to Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in trusted_folders()[1:]:
            search_path.append(provider="mvrecon plugin", path=f"file://{folder}")


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


@cache
def prepare_hydra() -> None:
    """Register with Hydra, in this process only, the apps' records, the plugins' config groups, and
    as choices the parts that have no config file of their own.
    """
    Plugins.instance().register(PluginConf)
    for app, record in RECORDS.items():
        ConfigStore.instance().store(name=f"{app}_schema", node=defaults_of(record))


def store_parts() -> None:
    """Register with Hydra, as choices, the parts that have no config file of their own."""
    for kind, registry in REGISTRIES.items():
        for name in registry.names():
            if choice_file(f"{kind}/{name}") is None:
                ConfigStore.instance().store(group=kind, name=name, node={"name": name})


def defaults_of(record: type) -> dict[str, Any]:
    """The settings of an app by default."""
    return {
        setting.name: setting.default
        if setting.default_factory is NO_DEFAULT
        else setting.default_factory()
        for setting in fields(record)
    }


def launch(task: Callable[[DictConfig], Any], app: str, record: type | None = None) -> None:
    """Run a task as a Hydra app on this process's command line; `--help` and `--version` are
    answered here, at once.

    All settings are checked before the task begins. An error ends the process with one line; with
    HYDRA_FULL_ERROR=1 with its traceback. Modules that the command line names in `plugins=` may
    also lie in the current folder.

    Args:
        task: f(config).
        app: name of its file of choices.
        record: a dataclass of all its settings; None: that of mvrecon's own app.

    Raises:
        SystemExit: an error, or Ctrl-C.
    """
    arguments, record = sys.argv[1:], record or RECORDS[app]
    if {"-h", "--help"} & set(arguments):
        sys.stdout.write(help_text(app))
        return
    if "--version" in arguments:
        sys.stdout.write(f"mvrecon {__version__}\n")
        return
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: no path ends a run
    if any(argument.lstrip("+").startswith("plugins=") for argument in arguments):
        sys.path.append(str(Path.cwd()))  # last: nothing there takes another module's place

    @reported
    @wraps(task)
    def checked(config: DictConfig) -> Any:
        check_settings(config, record)
        return task(config)

    with one_line(f"mvrecon-{app}"):
        silence_libraries()
        if {"-sc", "--shell-completion"} & set(arguments):
            if "hydra.searchpath" in os.environ.get("COMP_LINE", ""):
                return
            command = CommandLine(arguments, [], [])  # no folder is read while a word is typed
            prepare_hydra()
        else:
            command = prepared(arguments, app, record)
            command.check_shared_folder()
        sys.argv[1:] = [*command.overrides, *command.flags]
        if not command.flags:
            with hydra.initialize_config_dir(str(conf_dir()), app, guard.VERSION_BASE):
                config = hydra.compose(app, command.overrides, return_hydra_config=True)
            check_settings(config, record)
            if guard.is_plain(config):
                guard.run_once(reported(task), config, app, conf_dir())
                return
        run = hydra.main(
            config_path=str(conf_dir()), config_name=app, version_base=guard.VERSION_BASE
        )
        run(checked)()


def prepared(arguments: Sequence[str], app: str, record: type | None) -> CommandLine:
    """The command line in Hydra's grammar, its choices checked, and its folders of experiments
    stored as choices.

    Raises:
        LookupError, TypeError: a group that the app does not choose from, or none of it; an
            experiment of another app.
        PermissionError, Refused, FileNotFoundError: see `guard.store_foreign`.
    """
    prepare_hydra()
    store_parts()
    settings = fields(record) if record else ()
    sections = [setting.name for setting in settings if is_section(setting.type)]
    command = CommandLine.of(arguments, sections, texts_of(record) if record else ())
    for folder in command.folders:
        guard.store_foreign(Path(folder), groups())
    typed = OverridesParser.create().parse_overrides(command.overrides)
    return replace(command, overrides=check_choices(typed, app, record))


def texts_of(record: type) -> list[str]:
    """The settings of an app that are texts."""
    types = {setting.name: {m for m, _ in alternatives(setting.type)} for setting in fields(record)}
    return [name for name, members in types.items() if members <= TEXT_TYPES]


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
            if key in taken:
                needed = taken[key] is not None and not fits(None, options.get(key, Option()).type)
                names = value if isinstance(value, list) else [value]
                if not all(
                    isinstance(name, str) or (name is None and not needed) for name in names
                ):
                    raise TypeError(
                        f"{key}: expected one of {', '.join(choices()[key])}, got "
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
    for key in own:
        group, _, package = key.strip("/").partition("@")
        if group not in taken and package.partition(".")[0] not in known:
            raise LookupError(
                f"{place} is for another app: it chooses {group!r}, which is not here"
            )
        outer = package.partition(".")[0]
        if "." in package and outer in typed and typed[outer].value() != own.get(f"/{outer}"):
            raise LookupError(
                f"{place} has {outer} around another method; to choose that: {key.strip('/')}=..."
            )
    if unused := [key for key in values if key not in known | {"defaults", "hydra"}]:
        raise LookupError(
            f"{place} sets {unused[0]!r}, which is no setting of this app{hint(unused[0], known)}"
        )


def import_typed(settings: Sequence[str], app: str) -> None:
    """Import the modules of settings such as `plugins=[my_module]`, also from the current folder.

    Args:
        settings: as typed.
        app: begins the line of an error.

    Raises:
        SystemExit: not a plugin, or one that does not import.
    """
    sys.path.append(str(Path.cwd()))  # last: nothing there takes another module's place
    with one_line(app):
        lines = CommandLine.of(settings).overrides
        for setting in OverridesParser.create().parse_overrides(lines):
            modules: Any = setting.value()
            import_plugins(modules)


def check_settings(config: DictConfig, record: type) -> None:
    """Import the plugins of an app's composed config, and check its keys, parts and values; missing
    settings may come later.

    Raises:
        ImportError, PermissionError: an invalid module in `plugins`.
        LookupError, TypeError: an unused setting; a part's name, option or value.
        Refused: a `name` or `out` of an experiment that leads out of the output folder.
    """
    plain: Any = OmegaConf.to_container(config, resolve=False)
    settings = {key: value for key, value in plain.items() if key != "hydra"}
    if settings.get("plugins") != "???":
        import_plugins(settings.get("plugins"))
    check(settings, record)
    check_given(settings, record)
    for extra in LOGGER_EXTRAS & set(settings.get("logger") or ()):
        if locate(extra) is None:
            raise ImportError(f"logger={extra} needs {extra}: pip install 'mvrecon[{extra}]'")
    check_references(config)
    check_places(config)


def check_places(config: DictConfig) -> None:
    """Check that `name`, and an `out` that the command line does not type, lead into the folder of
    outputs.

    Raises:
        Refused: one leads out of it.
    """
    typed = "" if "hydra" not in config else " ".join(config.hydra.overrides.task)
    for key in ("name", "out"):
        given = key in config and not OmegaConf.is_missing(config, key) and config[key] is not None
        if given and (key == "name" or not re.search(r"(^| )\+*out=", typed)):
            guard.check_place(str(config[key]), f"The setting {key}={config[key]}")


def check_references(config: DictConfig) -> None:
    """Check that every reference to another setting resolves.

    Raises:
        LookupError: the other setting does not exist.
    """
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        OmegaConf.to_container(settings, resolve=True)
    except OmegaConfBaseException as error:
        if not isinstance(error, InterpolationKeyError):
            return  # the task reports others, such as a missing setting
        written = OmegaConf.to_container(settings, resolve=False)
        for key in str(error.full_key).split("."):
            written = written[key] if isinstance(written, dict) else written
        names = REFERENCE.findall(str(written))
        absent = [name for name in names if OmegaConf.select(settings, name) is None]
        raise LookupError(
            f"{error.full_key} takes its value from {', '.join(absent) or 'a setting'}, which has "
            f"none here; set {error.full_key}=..."
        ) from None


def choices() -> dict[str, list[str]]:
    """The names of all choices by group."""
    found: dict[str, set[str]] = {}
    for folder in trusted_folders():
        for file in folder.glob("*/*.yaml"):
            found.setdefault(file.parent.name, set()).add(file.stem)
    for kind, _, name in (point.name.partition(".") for point in installed()):
        if kind in REGISTRIES:
            found.setdefault(kind, set()).add(name)
    return {group: sorted(names) for group, names in sorted(found.items())}


def help_text(app: str) -> str:
    """The text of `--help`: the app's config groups with their choices, and its settings."""
    taken = {key.partition("@")[0] for key in groups_of(app)}
    lines = [f"  {g:<14}{', '.join(names)}" for g, names in choices().items() if g in taken]
    text = app_file(app).read_text(encoding="utf-8")
    record, settings = RECORDS.get(app), ""
    if record is not None:
        found = options_of(record)[0]
        given = {key: o for key, o in found.items() if o.default != MISSING and key not in taken}
        settings = "".join(f"{option.yaml(key)}\n" for key, option in given.items())
    return (
        f"Usage: mvrecon-{app} [group=choice ...] [key=value ...]\n\nGroups and their choices:\n"
        + "\n".join(lines)
        + f"\n\n{text}\n{settings}\n"
        "--cfg job shows all settings as composed, -m runs a sweep, --config-dir adds a folder of "
        "your own\n"
        "experiment/*.yaml, --hydra-help lists the other flags. mvrecon-list KIND shows the "
        "options of each\npart, mvrecon-list setting those of grid, views, data, acquisition and "
        "trainer.\n"
    )


def compose(*overrides: str, config_name: str = "train") -> dict[str, Any]:
    """The plain settings of a command line with these overrides.

    Raises:
        RuntimeError: Hydra is already in use in this process.
        LookupError: a setting that the app does not have, or one that must be given.
    """
    if GlobalHydra.instance().is_initialized():
        raise RuntimeError(
            "Hydra is in use already in this process: compose() must be called outside a Hydra app"
        )
    record = RECORDS.get(config_name)
    command = prepared(overrides, config_name, record)
    with hydra.initialize_config_dir(str(conf_dir()), config_name, guard.VERSION_BASE):
        config = hydra.compose(config_name, command.overrides, return_hydra_config=True)
    check_places(config)
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    if record is not None:
        known = [setting.name for setting in fields(record)]
        if unused := [str(key) for key in config if key not in known]:
            raise LookupError(
                f"This app does not use the setting {unused[0]!r}{hint(unused[0], known)}"
            )
    return labelled(to_plain(config), choices)


def labelled(settings: dict[str, Any], choices: Mapping[str, str | None]) -> dict[str, Any]:
    """Settings whose null `label` becomes the name of the main method's config file.

    Args:
        settings: plain.
        choices: file by config group, `hydra.runtime.choices`.
    """
    choice = choices.get("method")
    if not choice or settings.get("label", "") is not None:
        return settings
    return {**settings, "label": PurePosixPath(choice).name}


def command_folder() -> chdir[str]:
    """Context in the folder of the command, to which its relative paths refer, also with
    `hydra.job.chdir=true`, by which a task begins in the folder of its run.
    """
    return chdir(HydraConfig.get().runtime.cwd)


def to_plain(config: DictConfig) -> dict[str, Any]:
    """A composed config as plain dicts, lists, strings and numbers, with references resolved.

    Raises:
        LookupError: a missing `???` setting.
    """
    if missing := OmegaConf.missing_keys(config):
        raise LookupError(
            f"These settings must be given: {', '.join(f'{key}=...' for key in sorted(missing))}"
        )
    plain = OmegaConf.to_container(config, resolve=True)
    if not isinstance(plain, dict):
        raise TypeError(f"Settings must be a mapping, got {type(plain).__name__}")
    return {str(key): value for key, value in plain.items()}


def absolute_paths(settings: Mapping[str, Any], record: type) -> dict[str, Any]:
    """Make every path in plain settings absolute, so that they are valid from any folder.

    Args:
        settings: whose plugins are imported.
        record: of the app's settings.
    """

    def absolute(path: str, weights: bool) -> str:
        return str(of_weights(path) if weights else Path(path).expanduser().absolute())

    return with_paths(settings, record, absolute)
