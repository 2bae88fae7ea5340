"""Paths of the checkpoints in a run folder, and loading a trained method from one."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.data.module import SceneData
from mvrecon.engine.checkpoint_check import check_archive, check_known, check_settings
from mvrecon.engine.module import ReconstructionModule
from mvrecon.engine.storage import read
from mvrecon.engine.unfamiliar import warn_of_geometry, warn_of_values
from mvrecon.files.checks import blaming, plain_name
from mvrecon.geometry.grid import Grid
from mvrecon.parts import PROJECTORS


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

    module: ReconstructionModule = field(repr=False)
    seconds: float
    steps: int
    cases: list[str] | None = field(default_factory=list, repr=False)
    digests: dict[str, str] = field(default_factory=dict, repr=False)
    volumes: list[str] = field(default_factory=list, repr=False)

    @torch.no_grad()
    def __call__(
        self,
        views: Float[Tensor, "b 1 m v u"],
        cameras: Cameras | None = None,
        grid: Grid | None = None,
    ) -> Float[Tensor, "b 1 d h w"]:
        """The volume that the method reconstructs from views, in the unit of (views / mm); `module`
        has its gradient.

        Args:
            views: measured by the rig of the training, or by `cameras`.
            cameras: another rig; None: that of the training.
            grid: another grid of the volume; None: that of the training.

        Warns:
            UserWarning: another grid or range of values than in training, or another rig where it
                was trained on one.

        Raises:
            ValueError: views that do not fit the rig, or weights that fit the rig and the grid of
                the training alone.
        """
        A, name = self.module.projector, f"The trained {self.module.hparams['method']['name']}"
        if cameras is not None or grid is not None:
            A = PROJECTORS.from_config(
                self.module.hparams["geometry"]["projector"],
                grid=A.grid if grid is None else grid,
                cameras=A.cameras if cameras is None else cameras,
            ).to(A.device)
            warn_of_geometry(A, self.module, name)
        volume = self.module(views, A).volume
        warn_of_values(volume, self.module.hparams["data_range"], name)
        return volume


def finished(folder: Path, method: str) -> Path:
    """The checkpoint of a method whose training has ended."""
    return folder / "checkpoints" / f"{plain_name(method, 'a method')}.ckpt"


def unfinished(folder: Path, method: str) -> Path:
    """The last checkpoint of a method in training."""
    return folder / "checkpoints" / plain_name(method, "a method") / "last.ckpt"


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
