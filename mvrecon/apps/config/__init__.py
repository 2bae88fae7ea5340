"""Settings of the apps: their YAML files, composed by Hydra to plain dicts, and checked.

Apps pass on plain dicts, so that checkpoints load with torch's defaults. Importing this file
imports neither torch nor Lightning.
"""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass, field, fields, replace
from functools import cache, wraps
from io import TextIOWrapper
from pathlib import Path, PurePosixPath
from typing import Any

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Sweep
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf, open_dict
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from mvrecon import __version__
from mvrecon.apps.config import guard
from mvrecon.apps.config.errors import OF_METHODS, one_line, reported
from mvrecon.core.files.checks import shown, yaml_of
from mvrecon.core.machine import silence_libraries
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.quantities import fits, in_words
from mvrecon.core.registry import check_plugins, hint, import_plugins, installed, locate
from mvrecon.core.signatures import TABLES, check_parts, options_of, required


@dataclass
class Measurement:
    """Top-level keys shared by apps: scene, rig and measurement."""

    name: str = MISSING
    seed: int = 0
    grid: Any = None
    scene: Any = None
    camera: Any = None
    projector: Any = None
    acquisition: Any = None
    plugins: Any = field(default_factory=list)


@dataclass
class SimulateSettings(Measurement):
    """Every top-level key of `mvrecon-simulate`."""

    rtk: bool = False
    picture: str | None = None
    cases: list[int] = MISSING


@dataclass
class TrainSettings(Measurement):
    """Every top-level key of `mvrecon-train`."""

    test_scene: Any = None
    method: Any = None
    label: str | None = None
    compare: Any = field(default_factory=dict)
    loss: Any = field(default_factory=dict)
    optimizer: Any = None
    data: Any = None
    trainer: Any = None
    callbacks: Any = None
    logger: Any = None
    device: str = "auto"
    init_from: str | None = None
    resume: str | None = None


@dataclass
class ReconstructSettings:
    """Every top-level key of `mvrecon-reconstruct`."""

    name: str = MISSING
    views: Any = None
    camera: Any = None
    projector: Any = None
    grid: Any = MISSING
    method: Any = None
    correct: Any = None
    self_calibrate: bool = False
    left_out: bool = False
    out: str | None = None
    unit: str = MISSING
    stop: Any = None
    choose: Any = None
    calibrate: Any = None
    scatter: Any = None
    device: str = "auto"
    plugins: Any = field(default_factory=list)


@dataclass
class EvalSettings:
    """Every top-level key of `mvrecon-eval`, without those that the run fixes."""

    name: str = MISSING
    checkpoint: str = MISSING
    test_scene: Any = None
    acquisition: Any = None
    camera: Any = None
    grid: Any = field(default_factory=dict)
    data: Any = None
    compare: Any = field(default_factory=dict)
    device: str = "auto"
    save: bool = False
    plugins: Any = field(default_factory=list)


#: Settings that may be null or removed, which means none; and what is not an app's setting.
OPTIONAL = ("compare", "acquisition", "callbacks", "logger", "plugins", "defaults", "hydra")
#: Types of settings for which Hydra's schemas have none.
TYPES = {
    "name": "str",
    "seed": "NonNegativeInt",
    "device": "str",
    "out": "str",
    "plugins": "str | Sequence[str]",
    "calibrate": "str | Sequence[str]",
    "choose": "Mapping[str, Any]",
    "scatter": "Mapping[str, Any]",
}
#: What Hydra compares an app's settings with, and the app takes.
SCHEMAS = {
    "train_schema": TrainSettings,
    "eval_schema": EvalSettings,
    "simulate_schema": SimulateSettings,
    "reconstruct_schema": ReconstructSettings,
}


#: Settings of apps that are texts.
NAMES = {
    setting.name
    for schema in SCHEMAS.values()
    for setting in fields(schema)
    if setting.type in (str, str | None)
}
#: Settings whose options need not be in a file: those of parts and grid are in their signatures.
OF_PARTS = ("method", "compare", "scene", "test_scene", "grid", "camera", "projector", "correct")
#: Loggers of conf/logger that need a package, which the extra of the same name installs.
SERVICES = {"wandb", "mlflow"}
#: Further such settings of an app: those of the run that it evaluates.
OF_RUN = {"eval": ("acquisition", "data")}


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


def app_file(config_name: str) -> Path:
    """The YAML file of an app's settings.

    Raises:
        FileNotFoundError: no app has such a file.
    """
    folders = [str(folder) for folder in trusted_folders()]
    for file in (Path(folder, f"{config_name}.yaml") for folder in folders):
        if file.is_file():
            return file
    raise FileNotFoundError(
        f"No app has the settings {config_name}.yaml in any of {shown(folders)}"
    )


@cache
def prepare_hydra() -> None:
    """Register schemas and the plugins' config groups with Hydra, in this process only."""
    for name, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=name, node=schema)
    Plugins.instance().register(PluginConf)
    guard.register_untrusted_source()


def store_parts() -> None:
    """Register with Hydra, as choices, the parts that have no config file of their own."""
    folders = trusted_folders()
    for kind, registry in REGISTRIES.items():
        for name in registry.names():
            if not any((folder / kind / f"{name}.yaml").is_file() for folder in folders):
                node = {"name": name, **dict.fromkeys(required(kind, name), MISSING)}
                ConfigStore.instance().store(group=kind, name=name, node=node)


def launch(task: Callable[[DictConfig], Any], config_name: str) -> None:
    """Run a task as a Hydra app on this process's command line; `--help` and `--version` are
    answered here, at once.

    All settings are checked before the task imports torch. An error ends the process with one
    line; with HYDRA_FULL_ERROR=1 with its traceback. Modules that the command line names in
    `plugins=` may also lie in the current folder.

    Raises:
        SystemExit: an error, or Ctrl-C.
    """
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        sys.stdout.write(help_text(config_name))
        return
    if "--version" in arguments:
        sys.stdout.write(f"mvrecon {__version__}\n")
        return
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: no path ends a run
    if any(argument.lstrip("+").startswith("plugins=") for argument in arguments):
        sys.path.append(str(Path.cwd()))  # last: nothing there takes another module's place
    with one_line(f"mvrecon-{config_name}"):
        prepare_hydra()
        store_parts()
        silence_libraries()
        command = _command_line(arguments, config_name)
        sys.argv[1:] = [*command.overrides, *command.flags]
        if {"-sc", "--shell-completion"} & set(command.flags):
            if "hydra.searchpath" in os.environ.get("COMP_LINE", ""):
                return  # these folders are not read while a word is typed
        else:
            command.check_shared_folder()
            configs = []
            for config in guard.checked_configs(config_name, command, trusted_folders()):
                check_settings(config, config_name)
                configs.append(config)
            if not command.flags and guard.is_plain(configs[0]):
                guard.run_once(reported(task), configs[0], config_name, conf_dir())
                return

        @reported
        @wraps(task)
        def checked(config: DictConfig) -> Any:
            check_settings(config, config_name)
            return task(config)

        hydra.main(
            config_path=str(conf_dir()), config_name=config_name, version_base=guard.VERSION_BASE
        )(checked)()


def _command_line(arguments: Sequence[str], app: str) -> guard.CommandLine:
    command = guard.CommandLine.of(arguments, (*OF_PARTS, *OF_RUN.get(app, ())), NAMES)
    for key, default in yaml_of(app_file(app)).items():  # of these Hydra makes its folders
        if f"{key}=null" in command.overrides and isinstance(default, str):
            raise TypeError(f"{key}: expected a text such as {shown(default)}, got null")
    known, defaults = choices(), chosen(app_file(app))
    lines = [_choice(line, known, defaults) for line in command.overrides]
    return replace(command, overrides=lines)


def _choice(line: str, known: Mapping[str, set[str]], defaults: Mapping[str, Any]) -> str:
    """An override; of a group that may be without a choice, null as Hydra writes it.

    Args:
        line: in Hydra's grammar.
        known: choices by group.
        defaults: the app's own choices by group or group@place.

    Raises:
        TypeError: no choice of a group that needs one, or a value that is none.
    """
    key, sign, _ = line.partition("=")
    group, _, place = key.lstrip("+").partition("@")
    if not sign or key.startswith("~") or group not in known:
        return line
    value: Any = OverridesParser.create().parse_override(line).value()
    values = value.list if isinstance(value, ChoiceSweep) else value
    listed = values if isinstance(values, list) else [values]
    if listed and all(isinstance(each, str) and each for each in listed):
        return line
    if isinstance(value, dict | Sweep) and not isinstance(value, ChoiceSweep):
        return line  # settings of the part that is chosen; a sweep by a glob
    optional = group in OPTIONAL or (key in defaults and defaults[key] is None)
    if optional and value in (None, []):
        return f"~{key}"
    raise TypeError(
        f"{place or group}: expected one of {', '.join(sorted(known[group]))}, got {shown(value)}"
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
        lines = guard.CommandLine.of(settings).overrides
        for setting in OverridesParser.create().parse_overrides(lines):
            modules: Any = setting.value()
            import_plugins(modules)


def check_settings(config: DictConfig, app: str) -> None:
    """Check keys, plugins and parts of an app's composed config; missing settings may come later.

    Raises:
        ImportError, PermissionError: an invalid module in `plugins`.
        LookupError, TypeError: an unused setting; a part's name, option or value.
    """
    plain: Any = OmegaConf.to_container(config, resolve=False)
    settings = {key: value for key, value in plain.items() if key != "hydra"}
    check_keys(settings, app)
    check_given(settings, app)
    check_types(settings, app)
    if settings.get("plugins") != "???":
        check_plugins(settings.get("plugins"))
    check_parts(settings)
    for extra in SERVICES & set(settings.get("logger") or ()):
        if locate(extra) is None:
            raise ImportError(f"logger={extra} needs {extra}: pip install 'mvrecon[{extra}]'")
    check_references(config)


def check_given(settings: Mapping[str, Any], app: str) -> None:
    """Check that no setting with a default is null or removed; in an evaluation null stands for
    the run's.

    Raises:
        TypeError: one is.
    """
    written = yaml_of(app_file(app))
    groups = {key.rpartition("@")[2]: {} for key, name in chosen(app_file(app)).items() if name}
    for key, default in {**written, **groups}.items():
        if key in OPTIONAL or not key.isidentifier() or default is None:
            continue
        entries = isinstance(default, Mapping)
        of_run = entries and app == "eval"
        if key not in settings or (settings[key] is None and not of_run):
            expected = "a mapping of settings" if entries else f"a value such as {shown(default)}"
            raise TypeError(f"{key}: expected {expected}, got null")
    data = settings.get("data")
    if isinstance(data, Mapping) and "sizes" in data and data["sizes"] is None:
        raise TypeError("data.sizes: expected the numbers of train, val and test cases, got null")


def check_types(settings: Mapping[str, Any], app: str) -> None:
    """Check that settings with entries are mappings, and others of their type; what the entries
    are is checked by signatures.

    Raises:
        TypeError: another type.
    """
    written, groups = yaml_of(app_file(app)), {}
    for key in chosen(app_file(app)):
        group, _, place = key.partition("@")
        groups[place or group] = f"; to choose one: {key}=..."
    for key, value in settings.items():
        if value is None or value == "???" or "${" in str(value):
            continue
        entries = key in TABLES or isinstance(written.get(key), Mapping) or key in groups
        if entries and not isinstance(value, Mapping):
            raise TypeError(
                f"{key}: expected a mapping of settings, got {shown(value)}{groups.get(key, '')}"
            )
        if not fits(value, type := TYPES.get(key, "")):
            raise TypeError(f"{key}: expected {in_words(type)}, got {shown(value)}")


def check_references(config: DictConfig) -> None:
    """Check that every reference to another setting resolves.

    Raises:
        InterpolationKeyError: the other setting does not exist.
    """
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        OmegaConf.to_container(settings, resolve=True)
    except OmegaConfBaseException as error:
        if isinstance(error, InterpolationKeyError):
            raise  # the task reports others, such as a missing setting


def check_keys(settings: Mapping[str, Any], app: str) -> None:
    """Check top-level keys; Hydra itself accepts any `+key=...`.

    Raises:
        LookupError: a key that the app does not use.
    """
    written = yaml_of(app_file(app))
    groups = {key.rpartition("@")[2] for key in chosen(app_file(app))}
    schema = SCHEMAS.get(f"{app}_schema")
    names = [f.name for f in fields(schema)] if schema else []
    allowed = {*written, *groups, *names} - {"defaults"}
    if unused := [key for key in settings if key not in allowed]:
        known = {key for key in allowed if key.isidentifier()} - {"hydra", "experiment"}
        raise LookupError(
            f"This app does not use the setting {unused[0]!r}{hint(unused[0], known)}"
        )


def help_text(config_name: str) -> str:
    """The text of `--help`: the app's config groups with their choices, and its settings."""
    taken = groups_of(app_file(config_name))
    groups = "\n".join(
        f"  {group:<14}{', '.join(sorted(names))}"
        for group, names in sorted(choices().items())
        if group in taken
    )
    settings = app_file(config_name).read_text(encoding="utf-8")
    options = options_of("views") if "views" in taken else {}
    views = "".join(f"views.{option.line(name)}\n" for name, option in options.items())
    return (
        f"Usage: mvrecon-{config_name} [group=choice ...] [key=value ...]\n\nGroups and their "
        f"choices:\n{groups}\n\n"
        f"{settings}\n{views}\n"
        "--cfg job shows all settings as composed, -m runs a sweep, --config-dir adds a folder of "
        "your own\n"
        "experiment/*.yaml, --hydra-help lists the other flags. mvrecon-list shows each part's "
        "options.\n"
    )


def choices() -> dict[str, set[str]]:
    """The choices of every config group, in files and by installed parts."""
    found: dict[str, set[str]] = {}
    for folder in trusted_folders():
        for file in folder.glob("*/*.yaml"):
            found.setdefault(file.parent.name, set()).add(file.stem)
    for kind, _, name in (point.name.partition(".") for point in installed()):
        if kind in REGISTRIES:
            found.setdefault(kind, set()).add(name)
    return found


def chosen(app: Path) -> dict[str, str | None]:
    """The choices in an app's defaults list by group or group@place."""
    entries = yaml_of(app).get("defaults", ())
    groups = [entry for entry in entries if isinstance(entry, dict)]
    return {str(key): choice for entry in groups for key, choice in entry.items()}


def groups_of(app: Path) -> set[str]:
    """The config groups in an app's defaults list, and those of its methods."""
    groups = {re.sub("^override ", "", key).partition("@")[0].strip("/") for key in chosen(app)}
    return groups | (OF_METHODS if "method" in groups else set())


def compose(*overrides: str, config_name: str = "train") -> dict[str, Any]:
    """The plain settings of a command line with these overrides.

    Raises:
        RuntimeError: Hydra is already in use in this process.
    """
    if GlobalHydra.instance().is_initialized():
        raise RuntimeError(
            "Hydra is in use already in this process: compose() must be called outside a Hydra app"
        )
    prepare_hydra()
    store_parts()
    command = _command_line(overrides, config_name)
    (config,) = guard.checked_configs(config_name, command, trusted_folders())
    check_keys({str(key): None for key in config if key != "hydra"}, config_name)
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
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
