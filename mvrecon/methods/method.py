"""Methods: `method(views, A) -> Reconstruction`, whether classical or learned.

A registered method is a class of modules, which are called as `module(views, A)`, or a function
`f(A, views, **options)` that returns a volume.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import METHODS, PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.operators.checks import check_views
from mvrecon.operators.operator import Projector


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
