"""Guard of configs: a config file from elsewhere sets mvrecon's settings, never Hydra's own.

Before it calls a task, Hydra builds callbacks, launchers and log handlers from its own section,
sets environment variables and makes folders. A file that a user fetched must not choose these; the
command line may. So the same command line, and every job of a sweep, is composed and checked
before Hydra acts on it. Files of untrusted folders call no resolver (`${now:...}`), so that both
compositions are equal.
"""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mvrecon.core.files.checks import plain_name, shown, yaml_of
from mvrecon.core.files.runs import flatten

#: Keys of the section `hydra` that any file may set, or that Hydra fills in when it composes.
OPEN = {"mode", "verbose", "help", "sweeper.params", "runtime", "overrides", "job.override_dirname"}
#: Scheme of folders whose files are checked when Hydra reads them.
UNTRUSTED = "untrusted"
#: Flags that choose configs of other apps, or that Hydra shortens to them.
REFUSED_FLAGS = ("--config", "-cd", "-cp", "-cn", "--e")


@cache
def register_untrusted_source() -> None:
    """Make folders of the scheme `untrusted://` known to Hydra, in this process only."""
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
    """Check that no text in plain values calls a resolver of OmegaConf.

    Raises:
        PermissionError: one does; the message names the file.
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


def quoted(value: str | Sequence[str]) -> str:
    """A value in the grammar of Hydra's command line."""
    if not isinstance(value, str):
        return f"[{','.join(map(quoted, value))}]"
    return "'" + value.replace("'", r"\'") + "'"


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
    def of(cls, arguments: Sequence[str]) -> "CommandLine":
        """Split arguments; `--config-dir` becomes an entry of `hydra.searchpath`.

        Raises:
            PermissionError: a flag that chooses configs of other apps, or that unpickles a file;
                configs of Hydra's own in a folder from elsewhere.
            FileNotFoundError: no folder is there.
        """
        flags, overrides, searchpath, rest = [], [], [], iter(arguments)
        for argument in rest:
            name, sign, value = argument.partition("=")
            if name in ("--config-dir", "-cd"):
                folder = Path(value if sign else next(rest, "")).absolute()
                if not folder.is_dir():
                    raise FileNotFoundError(f"Expected a folder of configs, got {folder}")
                searchpath.append(f"file://{folder}")
            elif argument.startswith("--e"):
                raise PermissionError(
                    "--experimental-rerun unpickles a file, which can run anything; use "
                    "resume=<run folder>"
                )
            elif argument.startswith(REFUSED_FLAGS):
                raise PermissionError(
                    f"{argument}: --config-path and --config-name of other apps are not allowed; "
                    f"use --config-dir=..."
                )
            elif argument.startswith("-") or not (sign or argument.startswith("~")):
                flags.append(argument)
            elif name == "hydra.searchpath":
                paths: Any = OverridesParser.create().parse_override(argument).value()
                searchpath += paths or []
            else:
                overrides.append(argument)
        folders = [
            path.removeprefix("file://")
            for path in searchpath
            if path.startswith("file://") or "://" not in path
        ]
        if hydras := [folder for folder in folders if (Path(folder) / "hydra").exists()]:
            raise PermissionError(
                f"{shown(hydras)} has configs of Hydra's own; expected none in a folder of "
                f"experiments"
            )
        if searchpath:
            packages = [path for path in searchpath if path.startswith("pkg://")]
            checked = [f"{UNTRUSTED}://{folder}" for folder in folders]
            overrides.insert(0, f"hydra.searchpath={quoted([*packages, *checked])}")
        return cls(flags, overrides, folders)

    @property
    def sweeps(self) -> bool:
        """Whether a flag asks for a sweep."""
        return not {"-m", "--multirun"}.isdisjoint(self.flags)


class Guard:
    """Composes what a command line of an app chooses, and checks it.

    Args:
        app: name of its file of settings.
        command: the command line.
        trusted: folders of configs that are trusted; the first is mvrecon's own.
        version_base: of Hydra.
    """

    def __init__(
        self, app: str, command: CommandLine, trusted: Sequence[Path], version_base: str = "1.3"
    ):
        self.app, self.command, self.trusted = app, command, trusted
        self.version_base = version_base

    def checked(self) -> Iterator[DictConfig]:
        """The configs that Hydra would run with: of a sweep, that of the sweep itself, then those
        of its jobs.

        Every combination of the choices of config groups is among these jobs, and every value of
        another setting once.

        Raises:
            PermissionError: a file from elsewhere sets what only the command line may, or its jobs
                would be composed in other processes.
            Refused: a YAML file that is too large, or a `name` that leads out of the folder of
                outputs.
            HydraException: no such choice or setting.
        """
        with hydra.initialize_config_dir(str(self.trusted[0]), version_base=self.version_base):
            parser, lines = OverridesParser.create(), self.command.overrides
            fixed = [
                line
                for line, override in zip(lines, parser.parse_overrides(lines), strict=True)
                if not override.is_sweep_override()
            ]
            config = self._checked(fixed)
            sweeps = self.command.sweeps or config.hydra.mode == RunMode.MULTIRUN
            if not sweeps:
                yield config if fixed == lines else self._checked(lines)  # Hydra refuses these
                return
            yield config
            if self.command.folders and config.hydra.runtime.choices["hydra/launcher"] != "basic":
                raise PermissionError(
                    f"A sweep by another launcher composes its jobs in other processes, where "
                    f"configs are not checked; expected no --config-dir, got "
                    f"{shown(self.command.folders)}"
                )
            params = [f"{k}={v}" for k, v in (config.hydra.sweeper.get("params") or {}).items()]
            if self.command.folders and not any("hydra.sweeper.params" in line for line in lines):
                check_varied(parser.parse_overrides(params))
            for job in self._jobs(parser.parse_overrides([*params, *lines])):
                yield self._checked(job)

    def _jobs(self, overrides: Sequence[Override]) -> Iterator[list[str]]:
        """The overrides of a sweep's jobs; a range that is not discrete chooses no file."""
        groups, others = {}, {}
        for override in overrides:
            key = override.get_key_element()
            if not override.is_sweep_override():
                lines = [f"{key}={override.get_value_element_as_str()}"]
            elif override.is_discrete_sweep():
                lines = [f"{key}={value}" for value in override.sweep_string_iterator()]
            else:
                continue
            group = override.key_or_group
            folders = (*self.trusted, *self.command.folders)
            is_group = any(Path(folder, group.partition("@")[0]).is_dir() for folder in folders)
            (groups if is_group else others)[key] = lines  # the later one wins
        first = [lines[0] for lines in others.values()]
        for choice in itertools.product(*groups.values()):
            yield [*choice, *first]
        choice = [lines[0] for lines in groups.values()]
        for key, lines in others.items():
            rest = [other[0] for name, other in others.items() if name != key]
            for line in lines[1:]:
                yield [*choice, *rest, line]

    def _checked(self, overrides: list[str]) -> DictConfig:
        config = self._composed(overrides)
        if self.command.folders:
            self._check_foreign(config)
        for part in str(config.name).split("/") if "name" in config else []:
            plain_name(part, f"The setting name={config.name}")
        return config

    def _composed(self, overrides: list[str]) -> DictConfig:
        return hydra.compose(self.app, overrides, return_hydra_config=True)

    def _check_foreign(self, config: DictConfig) -> None:
        """Check that files from elsewhere change neither Hydra's own section nor `out`, the folder
        that an app writes to.

        Raises:
            PermissionError: they differ.
            Refused: an `out` that is made of settings which lead out of the folder of outputs.
        """
        lines = self.command.overrides
        typed = [line for line in lines if line.lstrip("+~").startswith(("hydra", "out="))]
        section = dict(flatten(_hydra_section(config)))
        expected = dict(flatten(_hydra_section(self._composed(typed))))
        changed = sorted(
            name
            for keys in {**section, **expected}
            if section.get(keys) != expected.get(keys)
            and not _is_open(name := ".".join(map(str, keys)))
        )
        if changed:
            raise PermissionError(f"A config sets {shown(changed)}; only a command line may")
        if "out" in config and not any(line.startswith("out=") for line in lines):
            for part in str(config.out).split("/"):
                plain_name(part, f"The setting out={config.out}")


def check_varied(overrides: Sequence[Override]) -> None:
    """Check what an experiment's `hydra.sweeper.params` varies, which becomes the overrides and the
    names of a sweep's jobs.

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


def _hydra_section(config: DictConfig) -> dict[str, Any]:
    """Hydra's own section as it is written, and the folder of outputs that it refers to."""
    written: Any = OmegaConf.to_container(config, resolve=False)
    return {key: written[key] for key in ("hydra", "out") if key in written}


def _is_open(key: str) -> bool:
    return any(f"{key}.".startswith(f"hydra.{prefix}.") for prefix in OPEN)
