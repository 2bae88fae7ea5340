"""Settings of the apps: composed by Hydra to plain dicts, and checked by the types of their record.

Importing this file imports neither torch nor Lightning; a check imports the parts that it checks.
"""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import fields, replace
from functools import cache, wraps
from io import TextIOWrapper
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from mvrecon import __version__
from mvrecon.apps.config import guard
from mvrecon.apps.config.choices import (
    check_choices,
    choice_file,
    conf_dir,
    files_by_group,
    groups,
    trusted_folders,
)
from mvrecon.apps.config.errors import one_line, reported
from mvrecon.apps.config.grammar import MULTIRUN, CommandLine
from mvrecon.apps.config.help import example_of, help_text
from mvrecon.apps.settings import RECORDS
from mvrecon.core.files.checks import file_in, from_home
from mvrecon.core.files.runs import of_weights
from mvrecon.core.machine import silence_libraries
from mvrecon.core.options import check, has_entries, is_section, with_paths
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.quantities import FILE_MARK, INSIDE_MARK, WEIGHTS_MARK
from mvrecon.core.registry import check_options, hint, import_plugins, locate
from mvrecon.core.signatures import alternatives

#: Loggers of conf/logger that need a package, which the extra of the same name installs.
LOGGER_EXTRAS = {"wandb", "mlflow"}
#: Beginnings of words that set something, by keys in Hydra's grammar, or are flags.
SETTING = re.compile(r"-|(~|\+{0,2}(?=[^=]+=))[\w/@:-]+(\.[\w/@:-]+)*(=|$)", re.ASCII)
#: Flags that a word follows.
FLAGS_OF_WORDS = {"--cfg", "-c", "--package", "-p", "--info", "-i", "--config-dir", "-cd"}
#: Types of settings that are texts.
TEXT_TYPES = {str, Path, NoneType}
#: A dataclass of all settings of an app.
Record = TypeVar("Record")


class PluginConf(SearchPathPlugin):
    """Adds the config folders of installed plugins to Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in trusted_folders()[1:]:
            search_path.append(provider="mvrecon plugin", path=f"file://{folder}")


@cache
def prepare_hydra() -> None:
    """Register with Hydra, in this process only, the apps' records and the plugins' config
    folders.
    """
    Plugins.instance().register(PluginConf)
    for app, record in RECORDS.items():
        ConfigStore.instance().store(name=f"{app}_schema", node=vars(record()))


def store_parts() -> None:
    """Register with Hydra, as choices, the parts that have no config file of their own."""
    files = files_by_group()
    for kind, registry in REGISTRIES.items():
        for name in registry.names():
            if name not in files.get(kind, ()):
                ConfigStore.instance().store(group=kind, name=name, node={"name": name})


def launch(task: Callable[[DictConfig], Any], app: str, record: type | None = None) -> None:
    """Run a task as a Hydra app on this process's command line; `--help` and `--version` are
    answered here, at once.

    All settings are checked before the task begins. An error ends the process with one line; with
    HYDRA_FULL_ERROR=1 with its traceback. Modules that the command line names in `plugins=` may
    also lie in the current folder.

    Args:
        task: function f(config) to run.
        app: name of its file of choices.
        record: a dataclass of all its settings; None: that of mvrecon's own app.

    Raises:
        SystemExit: an error, or Ctrl-C.
    """
    arguments, record = sys.argv[1:], record or RECORDS[app]
    if {"-h", "--help"} & set(arguments):
        sys.stdout.write(help_text(app, record))
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
            sys.argv[1:] = arguments  # no folder is read while a word is typed
            prepare_hydra()
        else:
            command = prepared(arguments, app, record)
            for override in OverridesParser.create().parse_overrides(command.overrides):
                if override.key_or_group == "plugins" and not override.is_sweep_override():
                    modules: Any = override.value()
                    import_plugins(modules)
                    store_parts()  # so that theirs can be chosen
            command.check_shared_folder()
            sys.argv[1:] = [*command.overrides, *command.flags]
            # before a folder is made
            config = composed(app, command.fixed if command.sweeps else command.overrides)
            guard.check_places(config)
            if command.sweeps and not config.hydra.sweeper.get("params"):
                for job in command.jobs:
                    check_settings(composed(app, job), record)
            if not command.flags:
                check_settings(config, record)
            # other flags show something, and benchmarks continue in their folder
            if MULTIRUN.issuperset(command.flags) and guard.OUTPUT in config.hydra.callbacks:
                sys.argv[1:1] = guard.own_folder(config, command.sweeps)
            if not command.flags and guard.is_plain(config):
                guard.run_once(reported(task), config, app, conf_dir())
                return
        run = hydra.main(
            config_path=str(conf_dir()), config_name=app, version_base=guard.VERSION_BASE
        )
        run(checked)()


def composed(app: str, overrides: list[str]) -> DictConfig:
    """Hydra's config of an app, with Hydra's own section.

    Raises:
        LookupError: choices that choose each other in a circle.
    """
    with hydra.initialize_config_dir(str(conf_dir()), app, guard.VERSION_BASE):
        try:
            return hydra.compose(app, overrides, return_hydra_config=True)
        except RecursionError:
            raise LookupError(
                "The `defaults` of the files that were chosen choose each other in a circle"
            ) from None


def prepared(arguments: Sequence[str], app: str, record: type | None) -> CommandLine:
    """The command line in Hydra's grammar, its choices checked, and its folders of experiments
    stored as choices.

    Raises:
        LookupError, TypeError: a word that sets nothing; a group that the app does not choose from,
            or none of it; an experiment of another app.
        PermissionError, Refused, FileNotFoundError: see `guard.store_foreign`.
    """
    prepare_hydra()
    settings = fields(record) if record else ()
    sections = [setting.name for setting in settings if is_section(setting.type)]
    tables = [setting.name for setting in settings if has_entries(setting.type)]
    command = CommandLine.of(arguments, sections, texts_of(record) if record else (), tables)
    for before, word in pairwise(["", *arguments]):
        if not (SETTING.match(word) or before in FLAGS_OF_WORDS):
            raise LookupError(
                f"Expected settings as key=value, such as {example_of(app)}, got {word!r}; --help "
                f"lists them"
            )
    guard.store_foreign(map(Path, command.folders), groups(), choice_file)
    typed = OverridesParser.create().parse_overrides(command.overrides)
    store_parts()
    return replace(command, overrides=check_choices(typed, app, record))


def texts_of(record: type) -> list[str]:
    """The settings of an app that are texts."""
    types = {setting.name: {m for m, _ in alternatives(setting.type)} for setting in fields(record)}
    return [name for name, members in types.items() if members <= TEXT_TYPES]


def check_settings(config: DictConfig, record: type) -> None:
    """Import the plugins of an app's composed config, and check its keys, parts and values; missing
    settings may come later.

    Raises:
        ImportError, PermissionError: an invalid module in `plugins`.
        LookupError, TypeError: an unused setting; a part's name, option or value.
        Refused: a `name` or `out` of an experiment that leads out of the output folder.
    """
    plain: Any = OmegaConf.to_container(config, resolve=False)
    if plain.get("plugins") != "???":
        import_plugins(plain.get("plugins"))
    settings = check_references(config)
    for place in ("callbacks", "logger"):
        entries = {k: v for k, v in (settings.get(place) or {}).items() if isinstance(v, dict)}
        whole = {key for key, node in entries.items() if {"_target_", "name"} & set(node)}
        for key in entries.keys() - whole:
            raise LookupError(f"{place}.{key} has no _target_ and no name{hint(key, whole)}")
    check(settings, record, complete=True)
    for extra in LOGGER_EXTRAS & set(settings.get("logger") or ()):
        if locate(extra) is None:
            raise ImportError(f"logger={extra} needs {extra}: pip install 'mvrecon[{extra}]'")
    guard.check_places(config)


def check_references(config: DictConfig) -> Any:
    """Check that every reference to another setting resolves; returns the plain settings with the
    values that they refer to, or as written where one is known to the task alone.

    Raises:
        LookupError: the other setting does not exist.
    """
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        return OmegaConf.to_container(settings, resolve=True)
    except OmegaConfBaseException as error:
        written: Any = OmegaConf.to_container(settings, resolve=False)
        if not isinstance(error, InterpolationKeyError):
            return written  # the task reports others, such as a missing setting
        for key in str(error.full_key).split("."):
            written = written[key] if isinstance(written, dict) else written
        raise LookupError(
            f"{error.full_key} takes its value from {written}, which has none here; set "
            f"{error.full_key}=..."
        ) from None


def compose(*overrides: str, config_name: str = "train") -> dict[str, Any]:
    """The plain settings of a command line with these overrides.

    Raises:
        RuntimeError: Hydra is already in use in this process.
        LookupError: a setting that must be given.
        TypeError: a setting that the app does not have.
    """
    if GlobalHydra.instance().is_initialized():
        raise RuntimeError(
            "Hydra is in use already in this process: compose() must be called outside a Hydra app"
        )
    record = RECORDS.get(config_name)
    command = prepared(overrides, config_name, record)
    config = composed(config_name, command.overrides)
    guard.check_places(config)
    chosen = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    if record is not None:
        check_options("This app", config, [setting.name for setting in fields(record)])
    return to_plain(config, chosen)


def command_folder() -> chdir[str]:
    """Context in the folder of the command, to which its relative paths refer, also with
    `hydra.job.chdir=true`, by which a task begins in the folder of its run.
    """
    return chdir(HydraConfig.get().runtime.cwd)


def to_plain(config: DictConfig, choices: Mapping[str, str | None] | None = None) -> dict[str, Any]:
    """A composed config as plain dicts, lists, strings and numbers, with references resolved.

    Args:
        config: a composed config without Hydra's section.
        choices: file by config group: a null `label` becomes the name of the main method's.

    Raises:
        LookupError: a missing `???` setting.
    """
    if missing := OmegaConf.missing_keys(config):
        raise LookupError(
            f"These settings must be given: {', '.join(f'{key}=...' for key in sorted(missing))}"
        )
    plain: Any = OmegaConf.to_container(config, resolve=True)
    choice = (choices or {}).get("method")
    if choice and plain.get("label", "") is None:
        plain["label"] = Path(choice).name
    return plain


def absolute_paths(settings: Mapping[str, Any], record: type) -> dict[str, Any]:
    """Make every path in plain settings absolute, so that they are valid from any folder.

    Args:
        settings: settings whose plugins are imported.
        record: the type of the app's settings.
    """

    def absolute(path: str, marks: tuple) -> str:
        if INSIDE_MARK in marks:
            return str(file_in(Path.cwd(), path, FILE_MARK not in marks) or path)
        return str(of_weights(path) if WEIGHTS_MARK in marks else from_home(path).absolute())

    return with_paths(settings, record, absolute)


def record_of(config: DictConfig, record: type[Record]) -> Record:
    """The settings of a composed config, with absolute paths, for the task that it runs.

    Raises:
        LookupError: a missing `???` setting.
    """
    settings = to_plain(config, HydraConfig.get().runtime.choices)
    with command_folder():
        return record(**absolute_paths(settings, record))
