"""Volumes from the views of several cameras: operators, classical methods, and networks that know
the geometry.

Every name is imported when it is first used, so `import mvrecon` costs nothing::

    import mvrecon as mv

    A = mv.Drr(mv.Grid.centred(64, spacing=4.0), mv.dcspect80(pixels=[32, 32]))
    volume = mv.sirt(A, A(x), iterations=50)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvrecon.data.volume_files import read_volume as read_volume, save_volume as save_volume
    from mvrecon.geometry.cameras.camera import Cameras as Cameras, ExplicitRays as ExplicitRays
    from mvrecon.geometry.cameras.convert import epipolar_line as epipolar_line
    from mvrecon.geometry.cameras.files import from_file as from_file
    from mvrecon.geometry.cameras.random_rigs import random_rig as random_rig
    from mvrecon.geometry.cameras.rigs import (
        arc as arc,
        circular as circular,
        dcspect80 as dcspect80,
        dome as dome,
        parallel as parallel,
    )
    from mvrecon.geometry.grid import Grid as Grid
    from mvrecon.methods.calibration.from_data import calibrated as calibrated
    from mvrecon.methods.calibration.markers import from_markers as from_markers
    from mvrecon.methods.classical.fdk import fbp as fbp, fdk as fdk, fdk_streamed as fdk_streamed
    from mvrecon.methods.classical.least_squares import cgls as cgls, tikhonov as tikhonov
    from mvrecon.methods.classical.mlem import mlem as mlem, osem as osem
    from mvrecon.methods.classical.sirt import os_sart as os_sart, sirt as sirt
    from mvrecon.methods.classical.stopping import held_out as held_out
    from mvrecon.methods.classical.total_variation import fista_tv as fista_tv, pdhg_tv as pdhg_tv
    from mvrecon.methods.classical.tv_map import tv_map as tv_map
    from mvrecon.methods.method import finer as finer, reconstruct as reconstruct
    from mvrecon.operators.drr import Drr as Drr
    from mvrecon.operators.operator import LinearOperator as LinearOperator
    from mvrecon.operators.radon import Radon as Radon
    from mvrecon.training.trained import (
        load as load,
        save_program as save_program,
        save_weights as save_weights,
    )

__version__ = "0.2.0.dev0"

#: Where each name is defined.
_MODULES = {
    "data.volume_files": "read_volume save_volume",
    "geometry.cameras.camera": "Cameras ExplicitRays",
    "geometry.cameras.convert": "epipolar_line",
    "geometry.cameras.files": "from_file",
    "geometry.cameras.random_rigs": "random_rig",
    "geometry.cameras.rigs": "arc circular dcspect80 dome parallel",
    "geometry.grid": "Grid",
    "methods.calibration.from_data": "calibrated",
    "methods.calibration.markers": "from_markers",
    "methods.classical.fdk": "fbp fdk fdk_streamed",
    "methods.classical.least_squares": "cgls tikhonov",
    "methods.classical.mlem": "mlem osem",
    "methods.classical.sirt": "os_sart sirt",
    "methods.classical.stopping": "held_out",
    "methods.classical.total_variation": "fista_tv pdhg_tv",
    "methods.classical.tv_map": "tv_map",
    "methods.method": "finer reconstruct",
    "operators.drr": "Drr",
    "operators.operator": "LinearOperator",
    "operators.radon": "Radon",
    "training.trained": "load save_program save_weights",
}
_DOOR = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _DOOR:
        from mvrecon.core.registry import hint

        raise AttributeError(f"mvrecon has no {name!r}{hint(name, _DOOR)}")
    return getattr(import_module(f"mvrecon.{_DOOR[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*_DOOR, "__version__"])
