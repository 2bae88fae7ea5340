"""Settings: where they live, how they are composed, and what may be built from them. The one door to Hydra.

Below this door everything is a plain dict of names and numbers, so that checkpoints load with torch's defaults
and no loop pays for a config object. Importing this file imports neither torch nor Lightning.
"""

import ast
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf

from mvrecon.guard import guarded
from mvrecon.limits import shown
from mvrecon.places import check_places, placed
from mvrecon.registry import importing, installed, locate

#: Where the classes that a `_target_` may name are defined, and what they must be.
ALLOWED = ("lightning.pytorch", "mvrecon.engine")
BASES = ("lightning.pytorch.callbacks.Callback", "lightning.pytorch.loggers.Logger")
VERSION_BASE = "1.3"


@dataclass
class Measurement:
    """The top-level keys that all apps share: what is measured, and by which rig."""

    name: str = MISSING
    seed: int = 0
    grid: Any = None
    scene: Any = None
    camera: Any = None
    plugins: Any = field(default_factory=list)


@dataclass
class Simulation(Measurement):
    """Every top-level key of `mvrecon-simulate`."""

    cases: list[int] = MISSING


@dataclass
class Settings(Measurement):
    """Every top-level key of `mvrecon-train`, so that a mistyped one is an error instead of a silent extra."""

    test_scene: Any = None
    projector: Any = None
    model: Any = None
    compare: Any = field(default_factory=dict)
    loss: Any = field(default_factory=dict)
    optimizer: Any = None
    data: Any = None
    trainer: Any = None
    callbacks: Any = None
    logger: Any = None
    resume: str | None = None


@dataclass
class Evaluation:
    """Every top-level key of `mvrecon-eval`: what the run itself decides, such as its camera, is not among them."""

    name: str = MISSING
    checkpoint: str = MISSING
    test_scene: Any = None
    data: Any = None
    compare: Any = field(default_factory=dict)
    device: str = "auto"
    save: bool = False
    plugins: Any = field(default_factory=list)


SCHEMAS = {"schema": Settings, "evaluation_schema": Evaluation, "simulation_schema": Simulation}


class PluginConf(SearchPathPlugin):
    """Adds the config folders of installed plugins to Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in plugin_conf_dirs():
            search_path.append(provider="mvrecon plugin", path=f"file://{folder}")


def conf_dir() -> Path:
    """Where the YAML files are: beside the code in a wheel, one level up in a checkout."""
    here = Path(__file__).resolve().parent
    return here / "conf" if (here / "conf").is_dir() else here.parent / "conf"


def plugin_conf_dirs() -> list[Path]:
    """The config folders that installed plugins declare (entry points named "conf.*"), found without an import."""
    packages = (locate(point.value) for point in installed() if point.name.startswith("conf."))
    return [Path(folder) for package in packages if package for folder in package.submodule_search_locations or ()]


def app_file(config_name: str) -> Path:
    """The YAML file of an app's settings: mvrecon's own, or that of an installed plugin.

    Raises:
        FileNotFoundError: no app has such a file.
    """
    folders = [conf_dir(), *plugin_conf_dirs()]
    for file in (folder / f"{config_name}.yaml" for folder in folders):
        if file.is_file():
            return file
    raise FileNotFoundError(f"No app has the settings {config_name}.yaml in any of {shown(map(str, folders))}")


def prepare_hydra() -> None:
    """Make the schemas and the plugins' config groups known to Hydra, in this process only."""
    for name, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=name, node=schema)
    Plugins.instance().register(PluginConf)


def launch(task: Callable[[DictConfig], Any], config_name: str) -> None:
    """Run a task as a Hydra app on this process's command line; `--help` is answered here, at once.

    Raises:
        PermissionError: the flag of Hydra's that unpickles a file.
    """
    if {"-h", "--help"} & set(sys.argv[1:]):
        sys.stdout.write(help_text(config_name))
        return
    if any(argument.startswith("--e") for argument in sys.argv[1:]):
        raise PermissionError("--experimental-rerun unpickles a file, which can run anything; use resume=<run folder>")
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: a path that it cannot write must not end a run
    prepare_hydra()
    with guarded(conf_dir(), plugin_conf_dirs()):
        hydra.main(config_path=str(conf_dir()), config_name=config_name, version_base=VERSION_BASE)(task)()


def help_text(config_name: str) -> str:
    """What an app can be told: every group with its choices, and the settings with their comments."""
    choices: dict[str, set[str]] = {}
    for folder in (conf_dir(), *plugin_conf_dirs()):
        for file in folder.glob("*/*.yaml"):
            choices.setdefault(file.parent.name, set()).add(file.stem)
    groups = "\n".join(f"  {group:<12}{', '.join(sorted(names))}" for group, names in sorted(choices.items()))
    settings = app_file(config_name).read_text(encoding="utf-8")
    return (
        f"Usage: mvrecon-{config_name} [group=choice ...] [key=value ...]\n\nGroups and their choices:\n{groups}\n\n"
        f"{settings}\n"
        "--cfg job shows all settings as composed, -m runs a sweep, --config-dir adds a folder of your own\n"
        "experiment/*.yaml, --hydra-help tells the other flags. mvrecon-list shows each part's options.\n"
    )


def compose(*overrides: str, config_name: str = "train") -> dict[str, Any]:
    """The plain settings that a command line with these overrides would run with.

    Raises:
        RuntimeError: another program in this process is using Hydra; it is left alone.
    """
    if GlobalHydra.instance().is_initialized():
        raise RuntimeError("Hydra is in use already in this process: compose() must be called outside a Hydra app")
    prepare_hydra()
    own = guarded(conf_dir(), plugin_conf_dirs())
    with own, hydra.initialize_config_dir(str(conf_dir()), version_base=VERSION_BASE):
        return to_plain(hydra.compose(config_name, list(overrides)))


def to_plain(config: DictConfig) -> dict[str, Any]:
    """A composed config as plain dicts, lists, strings and numbers, all references resolved.

    Raises:
        LookupError: a setting marked `???` was not given.
    """
    if missing := OmegaConf.missing_keys(config):
        raise LookupError(f"These settings must be given: {', '.join(f'{key}=...' for key in sorted(missing))}")
    plain = OmegaConf.to_container(config, resolve=True)
    if not isinstance(plain, dict):
        raise TypeError(f"Settings must be a mapping, got {type(plain).__name__}")
    return {str(key): value for key, value in plain.items()}


def import_plugins(modules: Iterable[str]) -> None:
    """Import the modules that the setting `plugins` names; they add parts by `@REGISTRY.register`.

    A setting can come from anywhere, so only a module that was written for mvrecon is imported: one whose source, read
    and not run, imports it.

    Raises:
        ImportError: a module does not import; the message names it.
        PermissionError: a module that is not a plugin.
    """
    for module in modules:
        if not _for_mvrecon(module):
            raise PermissionError(
                f"The setting 'plugins' names {shown(module)}; expected a module on Python's path whose own source "
                "imports mvrecon"
            )
        with importing(f"The plugin module {module!r} (setting 'plugins')"):
            import_module(module)


def _for_mvrecon(module: str) -> bool:
    if not all(part.isidentifier() for part in str(module).split(".")):
        return False
    spec = locate(module)
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return False
    nodes = list(ast.walk(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return any(name.split(".")[0] == "mvrecon" for name in names)


def instantiate(node: Mapping[str, Any], folder: Path, **given: Any) -> Any:
    """Build the callback or the logger that a node's `_target_` names, with the node's other entries as options.

    Args:
        node: `_target_` and options; places among these, such as `dirpath`, are taken from `folder`.
        folder: the run folder, out of which nothing is written.
        given: further options, which are trusted.

    Raises:
        PermissionError: the target is not a class of that kind that is defined below one of `ALLOWED`, every run has it
            already, or the options hold instructions of Hydra's such as another target, or lead out of the folder.
    """
    options = {key: value for key, value in node.items() if key != "_target_"}
    if instructions := _instructions(options):
        raise PermissionError(
            f"{shown(instructions)} in the options of a _target_ is not allowed; expected plain values"
        )
    made = _allowed(str(node["_target_"]))(**placed(options, folder), **given)
    check_places(made, folder)
    return made


def _instructions(node: Any) -> list[str]:
    if isinstance(node, Mapping):
        keys = [str(key) for key in node if str(key).startswith("_")]
        return keys + [found for value in node.values() for found in _instructions(value)]
    return [found for value in node for found in _instructions(value)] if isinstance(node, list | tuple) else []


def _allowed(target: str) -> type:
    """A class by its name. What it is decides, not how it is called: a name may lead out of a module (`a.b.os.system`),
    and a function of an allowed library may call whatever it is told to."""
    found = _found(target) if target.startswith(tuple(f"{name}." for name in ALLOWED)) else None
    if isinstance(found, type) and issubclass(found, tuple(map(_found, BASES))):
        if getattr(found, "of_every_run", False):
            raise PermissionError(f"_target_ {target!r} is not allowed; expected none that every run has already")
        if found.__module__.startswith(tuple(f"{name}." for name in ALLOWED)):
            return found
    raise PermissionError(
        f"_target_ {target!r} is not allowed; expected a class from {' or '.join(ALLOWED)} derived from "
        f"{' or '.join(BASES)}"
    )


def _found(target: str) -> Any:
    module, _, name = target.rpartition(".")
    try:
        return getattr(import_module(module), name, None)
    except ModuleNotFoundError:
        return None
