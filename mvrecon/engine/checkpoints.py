"""Paths of the checkpoints in a run folder, and loading a trained method from one."""

import os
from dataclasses import dataclass, field
from pathlib import Path

from mvrecon.data.module import SceneData
from mvrecon.engine.checkpoint_check import check_archive, check_known, check_settings
from mvrecon.engine.module import ReconstructionModule
from mvrecon.engine.run_folder import SETTINGS
from mvrecon.engine.storage import read
from mvrecon.files.atomic import check_plain
from mvrecon.files.checks import blaming, plain_name


@dataclass
class Trained:
    """A trained method with its weights and the record of its training.

    Args:
        module: with its weights.
        seconds: of training.
        steps: of the optimiser.
        cases: names of the training cases; None: the checkpoint is of a version that did not
            store them.
        digests: SHA-256 of the rig and of the files that it was trained with.
        volumes: SHA-256 of the training cases' volumes.
    """

    module: ReconstructionModule
    seconds: float
    steps: int
    cases: list[str] | None = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    volumes: list[str] = field(default_factory=list)


def finished(folder: Path, method: str) -> Path:
    """The checkpoint of a method whose training has ended."""
    return folder / "checkpoints" / f"{plain_name(method, 'a method')}.ckpt"


def unfinished(folder: Path, method: str) -> Path:
    """The last checkpoint of a method in training."""
    return folder / "checkpoints" / plain_name(method, "a method") / "last.ckpt"


def run_folder(path: str | Path) -> Path:
    """The run folder that a path names: itself, its `checkpoints` folder, or a checkpoint in it.

    Raises:
        FileNotFoundError: the path is not there, or no run folder is around it.
        PermissionError: anything but files and folders is in the run folder.
    """
    path = Path(os.path.abspath(Path(path).expanduser()))  # links in it are not followed yet
    if not path.exists():
        raise FileNotFoundError(f"No checkpoint or run folder is at {path}")
    for folder in (path, *path.parents[:3]):
        if (folder / SETTINGS).is_file():
            check_plain(folder)
            return folder.resolve()
    raise FileNotFoundError(
        f"Expected a checkpoint in a run folder (one with {SETTINGS}), got {path}"
    )


def load(path: Path) -> Trained:
    """A method from its checkpoint. Nothing in the file is run: it holds tensors, and the names of
    registered parts.

    Raises:
        FileNotFoundError: the method's training has not ended.
        DamagedCheckpoint: the file is not what was written.
        Refused: more than tensors and plain values, a part of a plugin that is not installed, or
            not the weights of the method that it describes.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"No checkpoint {path}: did the training of {path.stem!r} end? resume goes on with it"
        )
    check_archive(path)
    with blaming(path, "cannot be read"):
        state = read(path)
    with blaming(path, "does not fit this version's method", "was it written by another version?"):
        settings = check_settings(path, state["hyper_parameters"])
    check_known(path, settings)
    with blaming(path, "does not fit this version's method", "was it written by another version?"):
        module = ReconstructionModule(**settings)
        module.load_state_dict(state["state_dict"])
        seconds = float(state["callbacks"].get("Clock", {}).get("seconds", 0.0))
        data = state.get(SceneData.__qualname__, {})
        cases = list(map(str, data["cases"])) if "cases" in data else None
        known = dict(data.get("digests", {})), list(map(str, data.get("volumes", ())))
        return Trained(module.eval(), seconds, int(state["global_step"]), cases, *known)
