"""Guard of configs: a config file from elsewhere sets mvrecon's settings, never Hydra's own; and
the new folder of every run and sweep, made before Hydra writes.

Hydra builds callbacks, launchers and log handlers from its own section, sets environment variables
and makes folders before it calls a task. The command line may choose these, a fetched file must
not: the command line, and every job of a sweep, is composed and checked before Hydra acts on it.
Files of untrusted folders call no resolver (`${now:...}`), so that both compositions are equal.
"""

import itertools
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import configure_log, run_job
from hydra.experimental.callback import Callback
from hydra.plugins.config_source import ConfigSource
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from mvrecon.apps.config.grammar import in_grammar, quoted
from mvrecon.core.files.atomic import check_plain, new_folder
from mvrecon.core.files.checks import plain_name, shown, yaml_of
from mvrecon.core.files.runs import flatten, run_around
from mvrecon.core.machine import world

#: Keys of the section `hydra` that any file may set, or that Hydra fills in when it composes.
OPEN = re.compile(
    r"hydra\.(mode|verbose|help|sweeper\.params|runtime|overrides|job\.override_dirname)\."
)
#: Scheme of folders whose files are checked when Hydra reads them.
UNTRUSTED = "untrusted"
VERSION_BASE = "1.3"
#: Arguments that ask for a sweep.
MULTIRUN = {"-m", "--multirun", "hydra.mode=MULTIRUN"}


def register_untrusted_source() -> None:
    """Register the scheme `untrusted://` with Hydra, in this process only."""
    sources: Any = Plugins.instance().discover(ConfigSource)
    file_source: Any = next(source for source in sources if source.scheme() == "file")

    class UntrustedFolder(file_source):
        """A folder from elsewhere. Every file is bounded, and calls no resolver."""

        @staticmethod
        def scheme() -> str:
            return UNTRUSTED

        def load_config(self, config_path: str) -> Any:
            path = Path(self.path, self._normalize_file_name(config_path))
            if path.is_file():
                check_no_resolver(yaml_of(path), path)
            return super().load_config(config_path)

    Plugins.instance().register(UntrustedFolder)


def check_no_resolver(values: Any, path: Path) -> None:
    """Check that no text calls a resolver of OmegaConf.

    Raises:
        PermissionError: one does.
    """
    if isinstance(values, Mapping):
        values = [*values, *values.values()]
    if isinstance(values, list):
        for value in values:
            check_no_resolver(value, path)
    elif isinstance(values, str) and re.search(r"\$\{.*:", values, re.DOTALL):
        raise PermissionError(
            f"{path}: reads environment variables or calls another resolver by {shown(values)}; "
            f"only a command line may"
        )


@dataclass(frozen=True)
class CommandLine:
    """What a user typed for Hydra.

    Args:
        flags: such as `--cfg` and `job`.
        overrides: in Hydra's grammar; folders of configs are in `hydra.searchpath`.
        folders: of configs from elsewhere.
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
    ) -> "CommandLine":
        """Split arguments; `--config-dir` becomes an entry of `hydra.searchpath`, and texts are
        quoted where Hydra's grammar needs it.

        Args:
            arguments: as typed.
            sections: of settings whose options are set whether the app's own file has them or not,
                as by Hydra's ++.
            names: of settings that are texts.

        Raises:
            PermissionError: a flag that chooses configs of other apps, or that unpickles a file;
                configs of Hydra's own in a folder from elsewhere.
            FileNotFoundError: no folder is there.
        """
        flags, overrides, paths, rest = [], [], [], iter(arguments)
        sweeps = bool(MULTIRUN & set(arguments))
        for argument in rest:
            key, sign, value = argument.partition("=")
            if key in ("--config-dir", "-cd"):
                folder = Path(value if sign else next(rest, "")).absolute()
                if not folder.is_dir():
                    raise FileNotFoundError(f"Expected a folder of configs, got {folder}")
                paths.append(f"file://{folder}")
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
                typed: Any = OverridesParser.create().parse_override(line).value()
                paths += typed or []
            else:
                set_anyway = "++" if "." in key and key.partition(".")[0] in sections else ""
                text = in_grammar(key.lstrip("+~"), value, names, sweeps) if sign else ""
                overrides.append(f"{set_anyway}{key}{sign}{text}")
        packages = [path for path in paths if path.startswith("pkg://")]
        folders = [path.removeprefix("file://") for path in paths if path not in packages]
        if hydras := [folder for folder in folders if Path(folder, "hydra").exists()]:
            raise PermissionError(
                f"{shown(hydras)} has configs of Hydra's own; expected none in a folder of "
                f"experiments"
            )
        if paths:
            checked = [f"{UNTRUSTED}://{folder}" for folder in folders]
            overrides.insert(0, f"hydra.searchpath={quoted([*packages, *checked])}")
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
    def sweeps(self) -> bool:
        """Whether a flag asks for a sweep."""
        return not MULTIRUN.isdisjoint(self.flags)


def checked_configs(
    app: str, command: CommandLine, trusted: Sequence[Path]
) -> Iterator[DictConfig]:
    """The configs that Hydra would run with: of a sweep its own, then those of its jobs, with every
    combination of group choices and every value of other settings once.

    Args:
        app: name of its file of settings.
        command: what was typed.
        trusted: folders of configs; the first is mvrecon's own.

    Raises:
        PermissionError: a file from elsewhere sets what only the command line may, or its jobs
            would be composed in other processes.
        Refused: a YAML file that is too large, or a `name` that leads out of the output folder.
        HydraException: no such choice or setting.
    """
    parser, lines = OverridesParser.create(), command.overrides

    def checked(overrides: list[str]) -> DictConfig:
        config = hydra.compose(app, overrides, return_hydra_config=True)
        if command.folders:
            typed = [line for line in lines if line.lstrip("+~").startswith(("hydra", "out="))]
            check_foreign(config, hydra.compose(app, typed, return_hydra_config=True), typed)
        for part in str(config.name).split("/") if "name" in config else []:
            plain_name(part, f"The setting name={config.name}")
        return config

    with hydra.initialize_config_dir(str(trusted[0]), app, VERSION_BASE):
        typed = parser.parse_overrides(lines)
        fixed = [o.input_line or "" for o in typed if not o.is_sweep_override()]
        config = checked(fixed)
        if not command.sweeps and config.hydra.mode != RunMode.MULTIRUN:
            yield config if len(fixed) == len(lines) else checked(lines)  # Hydra refuses these
            return
        yield config
        if command.folders and config.hydra.runtime.choices["hydra/launcher"] != "basic":
            raise PermissionError(
                f"A sweep by another launcher composes its jobs in other processes, where configs "
                f"are not checked; expected no --config-dir, got {shown(command.folders)}"
            )
        params = config.hydra.sweeper.get("params") or {}
        varied = parser.parse_overrides([f"{key}={value}" for key, value in params.items()])
        if command.folders and not any("hydra.sweeper.params" in line for line in lines):
            check_varied(varied)
        for job in sweep_jobs([*varied, *typed], [*trusted, *map(Path, command.folders)]):
            yield checked(job)


def sweep_jobs(overrides: Sequence[Override], folders: Sequence[Path]) -> Iterator[list[str]]:
    """The overrides of a sweep's jobs, of the settings beside config groups one value at a time; a
    range that is not discrete chooses no file, and is left out.
    """
    groups, others = {}, {}
    for override in overrides:
        key = override.get_key_element()
        if not override.is_sweep_override():
            lines = [f"{key}={override.get_value_element_as_str()}"]
        elif override.is_discrete_sweep():
            lines = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            continue
        group = override.key_or_group.partition("@")[0]
        is_group = any((folder / group).is_dir() for folder in folders)
        (groups if is_group else others)[key] = lines  # of a key that stands twice, the later one
    first = {key: lines[0] for key, lines in others.items()}
    for choice in itertools.product(*groups.values()):
        yield [*choice, *first.values()]
    choice = [lines[0] for lines in groups.values()]
    for key, lines in others.items():
        for line in lines[1:]:
            yield [*choice, *(first | {key: line}).values()]


def check_foreign(config: DictConfig, expected: DictConfig, typed: Sequence[str]) -> None:
    """Check that files from elsewhere change neither Hydra's own section nor `out`.

    Args:
        config: composed.
        expected: composed without these files.
        typed: overrides of Hydra's section and of `out` on the command line.

    Raises:
        PermissionError: they differ.
        Refused: an `out` that leads out of the output folder.
    """
    found, allowed = (
        dict(flatten({key: plain[key] for key in ("hydra", "out") if key in plain}))
        for plain in (OmegaConf.to_container(c, resolve=False) for c in (config, expected))
        if isinstance(plain, dict)
    )
    names = {".".join(map(str, k)) for k in {**found, **allowed} if found.get(k) != allowed.get(k)}
    if changed := sorted(name for name in names if not OPEN.match(f"{name}.")):
        raise PermissionError(f"A config sets {shown(changed)}; only a command line may")
    if "out" in config and not any(line.startswith("out=") for line in typed):
        for part in str(config.out).split("/"):
            plain_name(part, f"The setting out={config.out}")


def check_varied(overrides: Sequence[Override]) -> None:
    """Check what an experiment's `hydra.sweeper.params` varies.

    Raises:
        PermissionError: a setting of Hydra's own, `out`, or a value with a path in it.
    """
    for override in overrides:
        line = override.input_line or ""
        if override.key_or_group.startswith("hydra") or override.key_or_group == "out":
            raise PermissionError(
                f"A config sets {shown(line)} in hydra.sweeper.params; only a command line may"
            )
        if set("/\\") & set(line):
            raise PermissionError(
                f"A config varies {shown(line)} in hydra.sweeper.params; expected no path there"
            )


#: Folders that did not exist before this process's run, the innermost first.
made: list[Path] = []

#: Where Hydra keeps the names of settings that the names of a sweep's runs leave out.
UNNAMED = "hydra.job.config.override_dirname.exclude_keys"


class OwnFolder(Callback):
    """Makes a separate folder for each run or sweep before Hydra writes into it.

    A folder from the command line or of a resumed run is kept. A sweep's runs are named by the
    settings that it varies. Hydra's log file appears with its first message.
    """

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """A run's folder."""
        place = Path(OmegaConf.select(config, "hydra.run.dir")).absolute()
        new = [folder for folder in (place, *place.parents) if not folder.exists()]
        self._prepare(config, "hydra.run.dir", {})
        chosen = Path(OmegaConf.select(config, "hydra.run.dir")).absolute()
        made[:] = [chosen, *new[1:]] if chosen != place else new

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """A sweep's folder."""
        tasks = OverridesParser.create().parse_overrides(list(config.hydra.overrides.task))
        fixed = [task.key_or_group for task in tasks if not task.is_sweep_override()]
        self._prepare(config, "hydra.sweep.dir", {UNNAMED: fixed})

    def _prepare(self, config: DictConfig, key: str, changes: dict[str, str | list[str]]) -> None:
        overrides, log = config.hydra.overrides.hydra, "hydra.job_logging.handlers.file"
        if OmegaConf.select(config, log):
            changes[f"{log}.delay"] = "true"
        if not any(line.lstrip("+").startswith(f"{key}=") for line in overrides):
            changes[key] = str(self._folder(config, key))
        with read_write(config), open_dict(config):
            for name, value in changes.items():
                OmegaConf.update(config, name, value)
                overrides.append(f"++{name}={quoted(value)}")  # a sweep's jobs are composed anew

    def _folder(self, config: DictConfig, key: str) -> Path:
        run = run_around(config.resume) if config.get("resume") else None
        if run is None:  # the app will say so
            place = OmegaConf.select(config, key)
            try:
                return new_folder(place)
            except OSError as error:
                raise type(error)(
                    f"{Path(place).absolute()} cannot be made ({error.strerror}); choose another "
                    f"folder: {key}=<folder>"
                ) from error
        check_plain(run)  # before Hydra opens a log in it
        return run


def is_plain(config: DictConfig) -> bool:
    """Whether a config is that of one run with nothing of Hydra's but our own callbacks."""
    own = {"own_folder", "sweep_table"} == set(config.hydra.callbacks)
    return own and config.hydra.mode != RunMode.MULTIRUN and not config.hydra.verbose


def run_once(task: Callable[[DictConfig], Any], config: DictConfig, app: str, conf: Path) -> None:
    """Run a task with a plain config; `hydra.main` does the same, but composes it twice more.

    Args:
        task: whose errors pass through Hydra.
        config: composed and checked.
        app: names the log file.
        conf: folder of mvrecon's configs.
    """
    callbacks: Any = OwnFolder()
    with hydra.initialize_config_dir(str(conf), app, VERSION_BASE):
        config.hydra.mode = RunMode.RUN
        configure_log(config.hydra.hydra_logging, config.hydra.verbose)
        callbacks.on_run_start(config)
        context = HydraContext(GlobalHydra.instance().config_loader(), callbacks)
        run_job(task, config, "hydra.run.dir", None, context)
