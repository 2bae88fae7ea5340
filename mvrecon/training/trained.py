"""Trained methods: loaded from a run, a checkpoint or a weights file; saved to a weights file."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon import __version__
from mvrecon.core.files.checks import file_errors
from mvrecon.core.files.runs import folder_of_run, of_weights, shipped_weights
from mvrecon.core.options import parts_in
from mvrecon.core.parts import PROJECTORS, MethodPart
from mvrecon.core.registry import hint, import_plugins
from mvrecon.data import digests
from mvrecon.data.module import SceneData
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.stopping import without
from mvrecon.methods.method import Reconstruction
from mvrecon.operators.operator import Projector
from mvrecon.operators.selection import ordered_subsets
from mvrecon.training import checkpoints, weights_file
from mvrecon.training.module import ReconstructionModule
from mvrecon.training.run_folder import read_settings

#: Range of a volume's greatest value relative to the training's value range.
USUAL_VALUE_RANGE = (0.05, 2.0)
#: Greatest values to name in a warning.
MAX_SHOWN_VALUES = 4
#: Folds of the views, each of which is predicted from the others.
FOLDS = 4
#: Error message and remedy for a file of another version's method.
OTHER_VERSION = ("does not fit this version's method", "was it written by another version?")


def warn_of_geometry(A: Projector, module: Any, source: str) -> None:
    """Warn if an operator's rig, grid or projector differs from the training's; not of the rig if
    trained on many.

    Args:
        A: the operator.
        module: the trained module.
        source: origin of the module, for the message.
    """
    known, lines = module.projector, []
    if A is known:
        return
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
    """Warn if the greatest value of any case of a reconstruction is far from the range of the
    training.
    """
    tops = volume.flatten(1).amax(dim=1).tolist()
    bad = [
        top for top in tops if not USUAL_VALUE_RANGE[0] <= top / data_range <= USUAL_VALUE_RANGE[1]
    ]
    if bad:
        reached = ", ".join(f"{top:.3g}" for top in bad[:MAX_SHOWN_VALUES])
        of_batch = f" in {len(bad)} of {len(tops)} cases" if len(tops) > 1 else ""
        warnings.warn(
            f"{source} was trained on values up to {data_range:g}; the reconstruction reaches "
            f"{reached}{of_batch}: do the views have another unit?",
            stacklevel=4,
        )


@dataclass
class Trained:
    """A trained method with its weights and the record of its training.

    Args:
        module: the method with its weights.
        seconds: duration of the training, in s.
        steps: number of steps of the optimiser.
        cases: names of the training cases; None if the checkpoint does not store them.
        digests: SHA-256 of the training's rig and files.
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
        fallback: bool = True,
    ) -> Float[Tensor, "b 1 d h w"]:
        """Reconstruct a volume from views, in the unit of (views / mm), without gradient; use
        `module` for that.

        Args:
            views: measured by the rig of the training, or by `cameras`.
            cameras: another rig; None: that of the training.
            grid: another grid of the volume; None: that of the training.
            fallback: see `reconstruct`.

        Warns:
            UserWarning: as `reconstruct`.

        Raises:
            ValueError: views that do not fit the rig, or weights tied to the training's rig and
                grid.
        """
        A, name = self.module.projector, f"The trained {self.module.hparams['method']['name']}"
        if cameras is not None or grid is not None:
            A = PROJECTORS.from_config(
                self.module.hparams["geometry"]["projector"],
                grid=A.grid if grid is None else grid,
                cameras=A.cameras if cameras is None else cameras,
            ).to(A.device)
        return self.reconstruct(views, A, name, fallback).volume

    @torch.no_grad()
    def reconstruct(
        self, views: Float[Tensor, "b 1 m v u"], A: Projector, name: str, fallback: bool = True
    ) -> Reconstruction:
        """Reconstruct views of an operator, without gradient.

        Args:
            views: measured views.
            A: the operator.
            name: name of the method, for warnings.
            fallback: for a network that was trained on many rigs, return the classical start where
                that predicts left-out views better. The check costs three more reconstructions.

        Warns:
            UserWarning: another grid, projector or range of values than in training, or another rig
                than its only one; a start that takes the place of the network's volume.
        """
        warn_of_geometry(A, self.module, name)
        method, settings = self.module.method.eval(), self.module.hparams
        out = method(views, A)
        many = settings["geometry"].get("rigs", 0) > 0
        if fallback and many and out.start is not None and len(A.cameras) >= FOLDS:
            bad = predicts_worse_than_start(method, A, views)
            if bad.any():
                warnings.warn(
                    f"{name} predicts left-out views worse than its classical start, which is "
                    f"returned for {int(bad.sum())} of {len(bad)} cases: is the object unlike the "
                    f"training's?",
                    stacklevel=3,
                )
                volume = torch.where(bad[:, None, None, None, None], out.start, out.volume)
                out = replace(out, volume=volume, sigma=None)
        warn_of_values(out.volume, settings["data_range"], name)
        return out


def predicts_worse_than_start(
    method: nn.Module, A: Projector, views: Float[Tensor, "b 1 m v u"]
) -> Bool[Tensor, " b"]:
    """Whether a network's volume of three quarters of the views predicts most of the others worse
    than its start does; a few faulty views do not decide.
    """
    worse = []
    for left in ordered_subsets(len(A.cameras), FOLDS):
        (A_kept, y_kept), (A_left, y_left) = without(A, views, left)
        out = method(y_kept, A_kept)
        errors = [(y_left - A_left(x)).flatten(3).norm(dim=3) for x in (out.volume, out.start)]
        worse.append(errors[0] > errors[1])
    return torch.cat(worse, dim=2).float().mean(dim=2)[:, 0] > 0.5


def load_checkpoint(path: Path) -> Trained:
    """Load a method from its checkpoint, which holds tensors and names of registered parts, and no
    code.

    Raises:
        FileNotFoundError: training has not finished.
        DamagedCheckpoint: the contents have changed.
        Refused: more than tensors and plain values, a part of a missing plugin, or weights of
        another method than described.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"No checkpoint {path}: did the training of {path.stem!r} end? resume=<run folder> "
            f"resumes it"
        )
    with file_errors(path, "cannot be read"):
        state = checkpoints.read(path)
    with file_errors(path, *OTHER_VERSION):
        module = _module(path, state["hyper_parameters"], state["state_dict"])
        seconds = float(state["callbacks"].get("Clock", {}).get("seconds", 0.0))
        data: Any = state.get(SceneData.__qualname__, {})
        cases = list(map(str, data["cases"])) if "cases" in data else None
        known = dict(data.get("digests", {})), list(map(str, data.get("volumes", ())))
        return Trained(module, seconds, int(state["global_step"]), cases, *known)


def _module(path: Path, settings: Any, weights: Mapping[str, Tensor]) -> ReconstructionModule:
    """Build the module that a file describes, with the file's weights."""
    settings = checkpoints.check_settings(path, settings)
    checkpoints.check_known(path, settings)
    module = ReconstructionModule(**settings)
    module.load_state_dict(weights)
    return module.eval()


def read_weights(path: Path) -> Trained:
    """Load a method from a file of `save_weights`; raises as `weights_file.read`, and Refused for
    weights of another method than described.
    """
    settings, training, weights = weights_file.read(path)
    with file_errors(path, *OTHER_VERSION):
        module = _module(path, settings, weights)
        return Trained(module, float(training["seconds"]), int(training["steps"]), cases=None)


def load(path: str | Path, method: str | None = None) -> Trained:
    """Load a trained method: `load(path)(views)` reconstructs, `load(path)(views, cameras, grid)`
    on another rig and grid.

    Args:
        path: path of a checkpoint, of weights (.safetensors) or of a run folder, whose setting
            `plugins` names modules to import; or the name of weights that are part of mvrecon.
        method: label of the method in the run's table; None: the run's main method. Ignored for a
            checkpoint, which holds one method.

    Returns:
        The method, which maps views to a volume, with the record of its training.

    Raises:
        FileNotFoundError: no such file, or training has not finished.
        LookupError: the run has no method of that label.
        DamagedCheckpoint: the contents have changed.
        Refused: more than tensors and plain values, or weights of another method than described.

    Examples:
        >>> trained = mv.load("any_rig")  # weights that are part of mvrecon
        >>> rig = mv.circular(6, sid=700, sdd=1000, detector={"pixels": [24, 32], "pixel_mm": 16.0})
        >>> grid = mv.Grid.centred(size=(32, 32, 32), spacing=(16.0, 10.0, 12.0))
        >>> views = mv.Drr(grid, rig)(torch.full((1, 1, *grid.shape), 0.02))
        >>> trained(views, rig, grid, fallback=False).shape
        torch.Size([1, 1, 32, 32, 32])
    """
    path = of_weights(path)
    if path.is_file():
        return read_weights(path) if path.suffix == weights_file.ENDING else load_checkpoint(path)
    if not path.exists():
        raise FileNotFoundError(
            f"No checkpoint or run folder is at {path}{hint(path.name, shipped_weights())}"
        )
    folder = folder_of_run(path)
    settings = read_settings(folder)
    labels = list(settings.methods())
    if method is not None and method not in labels:
        raise LookupError(f"The run {folder} has no method {method!r}. It has {', '.join(labels)}")
    import_plugins(settings.plugins)
    return load_checkpoint(checkpoints.finished(folder, method or labels[0]))


def check_trained(methods: Iterable[MethodPart]) -> None:
    """Load the weights of every method `trained` of a run, within another one too, and forget them.

    Raises:
        FileNotFoundError, LookupError, Refused: as `load`.
    """
    for _, kind, node in parts_in([*methods], Sequence[MethodPart]):
        if kind == "method" and node["name"] == "trained":
            load(node["checkpoint"], node.get("method"))


def save_weights(run: str | Path | Trained, path: str | Path, method: str | None = None) -> Path:
    """Write a trained method's weights, settings and training record to one file, for sharing and
    for other rigs; returns its path.

    The file's metadata are JSON under the key `mvrecon`: `settings` (grid and rig in mm, projector,
    method, loss, optimiser, value range), `training` (version, steps, seconds, number of cases) and
    `sha256`, that of the whole file with zeros in its place.

    Args:
        run: see `path` of `load`, or its result.
        path: path of the file, which ends with .safetensors.
        method: label of the method in the run's table; None: the run's main method.

    Returns:
        The path of the file.

    Raises:
        ValueError: another ending than .safetensors; and as `load`.

    Examples:
        >>> trained = mv.load("any_rig")
        >>> path = mv.save_weights(trained, "mine.safetensors")
        >>> mv.load(path).steps == trained.steps
        True
    """
    path = Path(path).expanduser()
    if path.suffix != weights_file.ENDING:
        raise ValueError(f"Expected a file {weights_file.ENDING}, got {path}")
    trained = run if isinstance(run, Trained) else load(run, method)
    training = {
        "version": __version__,
        "steps": trained.steps,
        "seconds": round(trained.seconds, 1),
        "cases": None if trained.cases is None else len(trained.cases),
    }
    module = trained.module
    weights_file.write(path, module.hparams, training, module.state_dict())
    return path


def begin_from(path: str | Path, module: ReconstructionModule) -> None:
    """Initialise a method with the weights of a trained one, for other data, another rig or grid;
    optimiser and schedule start anew.

    Args:
        path: see `load`: a run (its main method), a checkpoint or a weights file.
        module: a module with the same method.

    Raises:
        ValueError: weights of another method; and as `load`.
    """
    weights = load(path).module.method.state_dict()
    own = module.method.state_dict()
    differing = [
        name
        for name in {**weights, **own}
        if name not in weights or name not in own or weights[name].shape != own[name].shape
    ]
    if differing:
        raise ValueError(
            f"init_from={path}: expected weights of the same method, of whatever rig and grid; got "
            f"{len(differing)} that are not those of {module.hparams['method']['name']!r}, "
            f"{differing[0]} among them"
        )
    module.method.load_state_dict(weights)
