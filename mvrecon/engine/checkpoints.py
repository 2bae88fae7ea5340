"""Where a run keeps its checkpoints, and how its methods come back from them."""

from dataclasses import dataclass
from pathlib import Path

import torch

from mvrecon.engine.module import ReconstructionModule
from mvrecon.engine.record import SETTINGS


@dataclass
class Trained:
    """A method as a run left it.

    Args:
        module: with its weights.
        seconds: of training.
        steps: of the optimiser.
    """

    module: ReconstructionModule
    seconds: float
    steps: int


def finished(folder: Path, method: str) -> Path:
    """The checkpoint of a method whose training has ended."""
    return folder / "checkpoints" / f"{method}.ckpt"


def unfinished(folder: Path, method: str) -> Path:
    """The last checkpoint of a method in training."""
    return folder / "checkpoints" / method / "last.ckpt"


def run_folder(path: str | Path) -> Path:
    """The run folder that a path names: itself, its `checkpoints` folder, or a checkpoint in it.

    Raises:
        FileNotFoundError: the path is not there, or no run folder is around it.
    """
    path = Path(path).expanduser().resolve()
    if not path.exists():
        raise FileNotFoundError(f"No checkpoint or run folder is at {path}")
    for folder in (path, *path.parents[:3]):
        if (folder / SETTINGS).is_file():
            return folder
    raise FileNotFoundError(f"Expected a checkpoint in a run folder (one with {SETTINGS}), got {path}")


def load(path: Path) -> Trained:
    """A method from its checkpoint.

    Raises:
        FileNotFoundError: the method's training has not ended.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No checkpoint {path}: did the training of {path.stem!r} end? resume goes on with it")
    state = torch.load(path, map_location="cpu", weights_only=True)
    module = ReconstructionModule.load_from_checkpoint(path, map_location="cpu", weights_only=True).eval()
    return Trained(module, state["callbacks"].get("Clock", {}).get("seconds", 0.0), state["global_step"])
