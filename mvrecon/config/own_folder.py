"""A new folder for every run and every sweep, made before Hydra writes."""

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from mvrecon.files.atomic import check_plain, new_folder


class OwnFolder(Callback):
    """Makes the folder of a run or a sweep before Hydra writes into it, so that no two have the
    same.

    A folder that the command line names is taken as it is, and a resumed run has its folder
    already. Hydra's log file is made by the first message in it, so that a run that is refused
    leaves none.
    """

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """A run's folder."""
        self._prepare(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """A sweep's folder."""
        self._prepare(config, "hydra.sweep.dir")

    def _prepare(self, config: DictConfig, key: str) -> None:
        overrides, log, changes = (
            config.hydra.overrides.hydra,
            "hydra.job_logging.handlers.file",
            {},
        )
        if OmegaConf.select(config, log):
            changes[f"{log}.delay"] = "true"
        if not any(line.lstrip("+").startswith(f"{key}=") for line in overrides):
            changes[key] = str(self._folder(config, key))
        with read_write(config), open_dict(config):
            for name, value in changes.items():
                OmegaConf.update(config, name, value)
                quoted = value.replace("'", r"\'")
                overrides.append(f"++{name}='{quoted}'")  # a sweep's jobs are composed anew

    def _folder(self, config: DictConfig, key: str) -> Path:
        run = run_of(Path(config.resume)) if config.get("resume") else None
        if run is None:
            return new_folder(OmegaConf.select(config, key))
        check_plain(run)  # before Hydra opens a log in it
        return run


def run_of(path: Path) -> Path | None:
    """The run folder that a path names or lies in; None: there is none, as the app will say."""
    path = path.expanduser().absolute()
    folders = (path, *path.parents[:3])
    return next((folder for folder in folders if (folder / "config.yaml").is_file()), None)
