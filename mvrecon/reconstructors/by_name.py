"""A reconstruction from views, cameras and a grid alone, the method by its name."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.parts import METHODS, PROJECTORS


def reconstruct(
    views: Float[Tensor, "b c m v u"],
    cameras: Cameras,
    grid: Grid,
    method: str = "sirt",
    **options: Any,
) -> Float[Tensor, "b c d h w"]:
    """The volume that a method makes of line integrals, in the unit of (views / mm)::

        volume = mv.reconstruct(views, cameras, grid, method="fdk")

    The operator is `mv.Drr`, of parallel beams `mv.Radon`, on the views' device.

    Args:
        views: line integrals.
        cameras: the rig that measured them.
        grid: of the volume.
        method: a reconstructor's name; `mvrecon-list reconstructor` shows all, with their options.
        options: of the method.

    Raises:
        LookupError: an unknown method; the message gives the nearest name and all names.
        TypeError: an option that the method does not have.
        ValueError: views that do not fit the cameras, or are not finite.
    """
    name = "radon" if cameras.parallel else "drr"
    A = PROJECTORS.build(name, grid=grid, cameras=cameras).to(views.device)
    return METHODS.build(method, A, views, **options)
