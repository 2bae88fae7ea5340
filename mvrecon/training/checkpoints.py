"""Paths of the checkpoints in a run folder, and loading a trained method from one."""

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import file_errors, plain_name
from mvrecon.core.parts import PROJECTORS
from mvrecon.data import digests
from mvrecon.data.module import SceneData
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector
from mvrecon.training.checkpoint_check import check_archive, check_known, check_settings
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.storage import read

#: Of the training's value range: the greatest value of a volume is expected between these.
USUAL = (0.05, 2.0)


def warn_of_geometry(A: Projector, module: Any, source: str) -> None:
    """Warn where an operator's rig, grid or projector is not that of the training; of no rig where
    the network was trained on many.

    Args:
        A: the operator.
        module: the trained module.
        source: where it came from, for the message.
    """
    known, lines = module.projector, []
    many = module.hparams["geometry"].get("rigs", 0) > 0
    grid, trained_grid = A.grid, known.grid
    if not many and digests.of_rig(A.cameras) != digests.of_rig(known.cameras):
        counts = f"{len(known.cameras)} cameras of {known.cameras.shape} pixels"
        lines.append(f"rig ({counts}); got {len(A.cameras)} of {A.cameras.shape}")
    if grid.shape != trained_grid.shape or not torch.allclose(grid.affine, trained_grid.affine):
        got = f"{grid.shape} voxels of {grid.spacing} mm"
        lines.append(f"grid ({trained_grid.shape} of {trained_grid.spacing} mm); got {got}")
    if type(A) is not type(known):
        lines.append(f"projector ({type(known).__name__}); got {type(A).__name__}")
    for line in lines:
        warnings.warn(f"{source} was trained with another {line}", stacklevel=4)


def warn_of_values(volume: Tensor, data_range: float, source: str) -> None:
    """Warn where the greatest value of a reconstruction is far from the range of the training."""
    top = volume.amax().item() / data_range
    if not USUAL[0] <= top <= USUAL[1]:
        warnings.warn(
            f"{source} was trained on values up to {data_range:g}; the reconstruction reaches "
            f"{top * data_range:.3g}: do the views have another unit?",
            stacklevel=4,
        )


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
    with file_errors(path, "cannot be read"):
        state = read(path)
    with file_errors(
        path, "does not fit this version's method", "was it written by another version?"
    ):
        settings = check_settings(path, state["hyper_parameters"])
    check_known(path, settings)
    with file_errors(
        path, "does not fit this version's method", "was it written by another version?"
    ):
        module = ReconstructionModule(**settings)
        module.load_state_dict(state["state_dict"])
        seconds = float(state["callbacks"].get("Clock", {}).get("seconds", 0.0))
        data = state.get(SceneData.__qualname__, {})
        cases = list(map(str, data["cases"])) if "cases" in data else None
        known = dict(data.get("digests", {})), list(map(str, data.get("volumes", ())))
        return Trained(module.eval(), seconds, int(state["global_step"]), cases, *known)
