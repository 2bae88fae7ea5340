"""A new folder for every run and every sweep, made before Hydra writes."""

from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from mvrecon.apps.config.guard import quoted
from mvrecon.core.files.atomic import check_plain, new_folder
from mvrecon.core.files.runs import run_around
from mvrecon.core.machine import world

#: Where Hydra keeps the names of settings that the names of a sweep's runs leave out.
UNNAMED = "hydra.job.config.override_dirname.exclude_keys"


class OwnFolder(Callback):
    """Makes the folder of a run or a sweep before Hydra writes into it, so that no two have the
    same.

    A folder that the command line names is taken as it is, and a resumed run has its folder
    already. The runs of a sweep are named by the settings that it varies. Hydra's log file is made
    by the first message in it, so that a run that is refused leaves none.
    """

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """A run's folder.

        Raises:
            ValueError: a launcher has started several processes, which would each make its own.
        """
        lines = (*config.hydra.overrides.hydra, *config.hydra.overrides.task)
        if world() > 1 and not any(
            line.startswith(("hydra.run.dir=", "resume=")) for line in lines
        ):
            raise ValueError(
                f"Expected hydra.run.dir=... for the {world()} processes of one run, which share it"
            )
        self._prepare(config, "hydra.run.dir", {})

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
            return new_folder(OmegaConf.select(config, key))
        check_plain(run)  # before Hydra opens a log in it
        return run
