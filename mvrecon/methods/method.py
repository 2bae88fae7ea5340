"""Methods: `method(views, A) -> Reconstruction`, whether classical or learned.

A registered method is a class of modules, which are called as `module(views, A)`, or a function
`f(A, views, **options)` that returns a volume.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d

from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.core.quantities import PositiveInt
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, subdivided
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.checks import check_views
from mvrecon.operators.operator import LinearOperator, Projector


class Solver(nn.Module):
    """A classical method with its options; nothing to train.

    Args:
        solve: f(A, views, **options), which returns a volume.
        options: of the function.
    """

    def __init__(self, solve: Callable[..., Tensor], options: Mapping[str, Any]):
        super().__init__()
        self.solve, self.options = solve, dict(options)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        if not A.per_sample:
            return Reconstruction(self.solve(A, views, **self.options))
        samples = enumerate(views.split(1))
        volumes = [self.solve(A.of_sample(i), y, **self.options) for i, y in samples]
        return Reconstruction(torch.cat(volumes))


def build_method(config: Mapping[str, Any]) -> nn.Module:
    """A method by name and options, `{"name": ..., **options}`.

    Raises:
        LookupError: an unknown name.
        TypeError: no name, or an option that the method does not have.
    """
    METHODS.check(config)
    name, options = config["name"], {k: v for k, v in config.items() if k != "name"}
    part: Any = METHODS.get(name)
    method: Any = part(**options) if inspect.isclass(part) else Solver(part, options)
    return method


def reconstruct(
    views: Float[Tensor, "b c m v u"],
    cameras: Cameras,
    grid: Grid,
    method: str = "sirt",
    **options: Any,
) -> Float[Tensor, "b c d h w"]:
    """The volume that a method reconstructs from views, cameras and a grid alone, in the unit of
    (views / mm)::

        volume = mv.reconstruct(views, cameras, grid, method="fdk")

    The operator is `mv.Drr`, of parallel beams `mv.Radon`, on the views' device.

    Args:
        views: line integrals.
        cameras: the rig that measured them.
        grid: of the volume.
        method: its name; `mvrecon-list method` shows all, with their options.
        options: of the method.

    Raises:
        LookupError: an unknown method; the message gives the nearest name and all names.
        TypeError: an option that the method does not have.
        ValueError: views that do not fit the cameras, or are not finite.
    """
    name = "radon" if cameras.parallel else "drr"
    A = PROJECTORS.build(name, grid=grid, cameras=cameras).to(views.device)
    return build_method({"name": method, **options}).to(views.device)(views, A).volume


#: The method where none is given.
SIRT = {"name": "sirt", "iterations": 25, "momentum": True}


def finer(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    fine: PositiveInt = 2,
    method: Mapping[str, Any] | None = None,
    support: Bool[Tensor, "d h w"] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Reconstruct by another method on a finer grid, with rays as much closer, and average its
    voxels to those of the grid, in the unit of the volume.

    Under a grid of few voxels the truth itself misses its views by some percent: what a coarse grid
    and one thin ray a pixel cannot hold. Time and memory grow with fine^3.

    Args:
        A: the operator, with the capability "refine".
        views: in the operator's unit.
        fine: voxels along each axis in one of the grid's, and rays each way in one of a pixel's.
        method: name and options of the method; None: 25 iterations of SIRT with momentum.
        support: the voxels of the grid that may be anything but zero.

    Raises:
        ValueError: an operator that is not known on another grid, less than one voxel in a voxel,
            and what the method refuses.
        LookupError, TypeError: an unknown method, or an option that it does not have.
    """
    check_factor("fine", fine)
    _, volume = on_finer_grid(A, views, fine, method or SIRT, support)
    return avg_pool3d(volume, fine)


def on_finer_grid(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    fine: int,
    method: Mapping[str, Any],
    support: Bool[Tensor, "d h w"] | None = None,
) -> tuple[LinearOperator, Float[Tensor, "b c e i x"]]:
    """The operator of a grid `fine` times finer, and a method's volume there, in the unit of
    the volume; see `finer`.
    """
    mask = {} if support is None else {"support": subdivided(support, fine)}
    B = A.refined(fine)
    return B, METHODS.from_config(method, B, views, **mask)


def check_factor(name: str, factor: Any) -> None:
    """Check by how many times a grid is to be finer.

    Raises:
        ValueError: no whole number above 0.
    """
    if not isinstance(factor, int) or factor < 1:
        raise ValueError(f"Expected {name}, a whole number of at least 1, got {factor!r}")
