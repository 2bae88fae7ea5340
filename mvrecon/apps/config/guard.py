"""Guard of configs: experiments from elsewhere are data, which set mvrecon's settings and never
Hydra's own; and the new folder of every run and sweep, made before Hydra writes.

Hydra builds callbacks, launchers and log handlers from its own section, sets environment variables
and makes folders before it calls a task. The command line may choose these, a fetched file must
not: such files are not on Hydra's search path. Each is read as plain YAML, checked, and stored
under its name as a choice.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import configure_log, run_job
from hydra.experimental.callback import Callback
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from mvrecon.apps.config.grammar import quoted
from mvrecon.core.files.atomic import check_plain, check_writable, new_folder
from mvrecon.core.files.checks import MAX_YAML_BYTES, plain_name, shown, text_of, yaml_in
from mvrecon.core.files.runs import SETTINGS, flatten, run_around

VERSION_BASE = "1.3"
#: A file's directive of Hydra's for where its settings go.
PACKAGE_DIRECTIVE = re.compile(r"^\s*#\s*@package\s+(\S+)", re.MULTILINE)
#: Settings that name where a command writes.
WRITE_SETTINGS = ("out", "resume")


def store_foreign(
    folders: Iterable[Path], groups: Collection[str], taken: Callable[[str], object]
) -> None:
    """Store the files of folders from elsewhere as choices of their groups, in this process only.

    Args:
        folders: folders with files <group>/<name>.yaml.
        groups: groups of configs.
        taken: f("<group>/<name>"), whether mvrecon's own choices have this name.

    Raises:
        FileNotFoundError: no folder is there.
        PermissionError: a file sets what only a command line may, or has the name of mvrecon's own
            choice or of another folder's; a link that leads out of the folder, or no file.
        Refused: a file that is too large, or not YAML; a `name` that leads out of the output
            folder.
    """
    stored: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"Expected a folder of configs, got {folder}")
        if (folder / "hydra").exists():
            raise PermissionError(
                f"{folder} has configs of Hydra's own; expected none in a folder of experiments"
            )
        for path in sorted(p for g in groups for p in (folder / g).glob("*.yaml")):
            choice = f"{path.parent.name}/{path.stem}"
            if not (path.resolve().is_relative_to(folder.resolve()) and path.is_file()):
                raise PermissionError(
                    f"{path}: expected a file within {folder}, got a link or no file"
                )
            if owner := "mvrecon's own choice" if taken(choice) else stored.get(choice):
                raise PermissionError(f"{path}: {owner} has this name; expected another")
            stored[choice] = path
            _store(path)


def _store(path: Path) -> None:
    """Check a file from elsewhere, and store it as a choice."""
    text = text_of(path, MAX_YAML_BYTES)
    values = yaml_in(text, path) or {}  # bounded, and without tags
    if not isinstance(values, Mapping):
        raise PermissionError(f"{path}: expected a mapping of settings, got {shown(values)}")
    if odd := [key for node in mappings_in(values) for key in node if not isinstance(key, str)]:
        raise PermissionError(f"{path}: expected texts as keys, got {shown(odd[0])}")
    packages = PACKAGE_DIRECTIVE.findall(text)
    if packages not in ([], ["_global_"]):
        raise PermissionError(f"{path}: expected no @package but _global_, got {packages}")
    node, group = OmegaConf.create(text or "{}"), path.parent.name
    check_foreign(OmegaConf.to_container(node), path, whole=bool(packages))
    where = packages[0] if packages else group
    ConfigStore.instance().store(path.stem, node, group, where, provider=str(path))


def check_foreign(values: Any, path: Path, whole: bool) -> None:
    """Check the plain values of a file from elsewhere.

    Args:
        values: the file's content.
        path: path of the file.
        whole: whether they are an app's settings; else the options of a part.

    Raises:
        PermissionError: it sets Hydra's section, `out` or `resume`, chooses configs of Hydra's, or
            calls a resolver of OmegaConf.
        Refused: a `name` that leads out of the output folder; settings that are no mapping.
    """
    settings = ("hydra", *WRITE_SETTINGS) if whole else ("hydra",)
    if told := {key: values[key] for key in settings if key in values}:
        named = sorted(".".join(map(str, keys)) for keys, _ in flatten(told))
        raise PermissionError(f"A config sets {shown(named)}; only a command line may: {path}")
    for text in texts_in(values.get("defaults", [])):
        if "hydra" in text or ".." in text or re.search("@(_|$)", text):
            raise PermissionError(
                f"A config sets ['hydra...'] or all settings by its choice {shown(text)}; only a "
                f"command line may: {path}"
            )
    for text in texts_in(values):
        if re.search(r"\$\{.*:", text, re.DOTALL):
            raise PermissionError(
                f"{path}: reads environment variables or calls another resolver by {shown(text)}; "
                f"only a command line may"
            )
    if whole and isinstance(name := values.get("name"), str):
        check_place(name, f"{path}: the setting name={name}")


def check_place(name: str, what: str) -> None:
    """Check that a name, with / for folders, leads into the folder of outputs.

    Raises:
        Refused: it leads out.
    """
    for part in name.split("/"):
        plain_name(part, what)


def check_places(config: DictConfig) -> None:
    """Check that `name`, and an `out` that the command line does not type, lead into the folder of
    outputs.

    Raises:
        Refused: one leads out of it.
    """
    whole: Any = config if "hydra" in config else HydraConfig.instance().cfg  # of a job: beside it
    typed = "" if whole is None else " ".join(as_typed(whole.hydra))
    for key in ("name", "out"):
        given = key in config and not OmegaConf.is_missing(config, key) and config[key] is not None
        if given and (key == "name" or not re.search(r"(^| )\+*out=", typed)):
            check_place(str(config[key]), f"The setting {key}={config[key]}")


def as_typed(hydra: Any, kind: str = "task") -> list[str]:
    """The overrides of a task, or of Hydra itself, as a command line has them: OmegaConf would take
    what they refer to for its own.
    """
    overrides: Any = OmegaConf.to_container(hydra.overrides, resolve=False)
    return overrides[kind]


def mappings_in(values: Any) -> Iterator[Mapping[Any, Any]]:
    """All mappings within plain values."""
    if isinstance(values, Mapping):
        yield values
    if isinstance(values, Mapping | list):
        for value in values.values() if isinstance(values, Mapping) else values:
            yield from mappings_in(value)


def texts_in(values: Any) -> Iterator[str]:
    """All texts within plain values, keys included."""
    if isinstance(values, str):
        yield values
    if isinstance(values, Mapping):
        values = [*values, *values.values()]
    if isinstance(values, list):
        for value in values:
            yield from texts_in(value)


#: Folders that did not exist before this process's run, the innermost first.
made: list[Path] = []

#: The callback of `conf/hydra/output`, whose runs each have a new folder.
OUTPUT = "sweep_table"
#: Where Hydra has the file of its log.
LOG_FILE = "hydra.job_logging.handlers.file"
#: Where Hydra keeps the names of settings that the names of a sweep's runs leave out.
EXCLUDED_KEYS = "hydra.job.config.override_dirname.exclude_keys"


def own_folder(config: DictConfig, sweeps: bool) -> list[str]:
    """Make a separate folder for a run or sweep before Hydra writes into it; returns the overrides
    that say so, which `config` has then.

    A folder from the command line or of a resumed run is kept. A sweep's runs are named by the
    settings that it varies. Hydra's log file appears with its first message.

    Args:
        config: composed config; for a sweep, without the settings that it varies.
        sweeps: whether the command line asks for a sweep.

    Raises:
        OSError: the folder cannot be made or written.
        PermissionError: a resumed run's holds anything but files and folders.
    """
    key = "hydra.sweep.dir" if sweeps else "hydra.run.dir"
    changes: dict[str, str | list[str]] = {}
    if OmegaConf.select(config, LOG_FILE):
        changes[f"{LOG_FILE}.delay"] = "true"
    if sweeps:
        tasks = OverridesParser.create().parse_overrides(as_typed(config.hydra))
        changes[EXCLUDED_KEYS] = [task.key_or_group for task in tasks]
    place = folder = Path(OmegaConf.select(config, key)).absolute()
    new = [each for each in (place, *place.parents) if not each.exists()]
    if not any(line.lstrip("+").startswith(f"{key}=") for line in as_typed(config.hydra, "hydra")):
        run = run_around(config.resume) if config.get("resume") else None
        try:
            folder = run or new_folder(place)  # without one the app will say so
        except OSError as error:
            raise type(error)(
                f"{place} cannot be made ({error.strerror}); choose another folder: {key}=<folder>"
            ) from error
        if run is not None:
            check_plain(run)  # before Hydra opens a log in it
        changes[key] = str(folder)
    else:
        check_writable(place / SETTINGS)
    made[:] = new if folder == place else [folder, *new[1:]]
    with read_write(config), open_dict(config):
        for name, value in changes.items():
            OmegaConf.update(config, name, value)
    return [f"++{name}={quoted(value)}" for name, value in changes.items()]


def is_plain(config: DictConfig) -> bool:
    """Whether a config is that of one run with nothing of Hydra's but our own callback."""
    own = {OUTPUT} == set(config.hydra.callbacks)
    return own and config.hydra.mode != RunMode.MULTIRUN and not config.hydra.verbose


def run_once(task: Callable[[DictConfig], Any], config: DictConfig, app: str, conf: Path) -> None:
    """Run a task with a plain config; `hydra.main` does the same, but composes it twice more.

    Args:
        task: function f(config), whose errors pass through Hydra.
        config: composed and checked config.
        app: name of the app and of its log file.
        conf: folder of mvrecon's configs.
    """
    callbacks: Any = Callback()
    with hydra.initialize_config_dir(str(conf), app, VERSION_BASE):
        config.hydra.mode = RunMode.RUN
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        context = HydraContext(GlobalHydra.instance().config_loader(), callbacks)
        run_job(task, config, "hydra.run.dir", None, context)
