"""Volumes from the views of several cameras: operators, classical methods, and networks that know
the geometry.

The front door. Every name is imported when it is first used, so `import mvrecon` costs nothing::

    import mvrecon as mv

    A = mv.Drr(mv.Grid.centred(64, spacing=4.0), mv.dcspect80(pixels=[32, 32]))
    volume = mv.sirt(A, A(x), iterations=50)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvrecon.data.volume_files import read_volume as read_volume
    from mvrecon.data.volume_files import save_volume as save_volume
    from mvrecon.geometry.cameras.camera import Cameras as Cameras
    from mvrecon.geometry.cameras.camera import ExplicitRays as ExplicitRays
    from mvrecon.geometry.cameras.convert import epipolar_line as epipolar_line
    from mvrecon.geometry.cameras.files import from_file as from_file
    from mvrecon.geometry.cameras.random_rigs import random_rig as random_rig
    from mvrecon.geometry.cameras.rigs import arc as arc
    from mvrecon.geometry.cameras.rigs import circular as circular
    from mvrecon.geometry.cameras.rigs import dcspect80 as dcspect80
    from mvrecon.geometry.cameras.rigs import dome as dome
    from mvrecon.geometry.cameras.rigs import parallel as parallel
    from mvrecon.geometry.grid import Grid as Grid
    from mvrecon.methods.calibration.from_data import calibrated as calibrated
    from mvrecon.methods.calibration.markers import from_markers as from_markers
    from mvrecon.methods.classical.fdk import fbp as fbp
    from mvrecon.methods.classical.fdk import fdk as fdk
    from mvrecon.methods.classical.fdk import fdk_streamed as fdk_streamed
    from mvrecon.methods.classical.least_squares import cgls as cgls
    from mvrecon.methods.classical.least_squares import tikhonov as tikhonov
    from mvrecon.methods.classical.mlem import mlem as mlem
    from mvrecon.methods.classical.mlem import osem as osem
    from mvrecon.methods.classical.sirt import os_sart as os_sart
    from mvrecon.methods.classical.sirt import sirt as sirt
    from mvrecon.methods.classical.stopping import held_out as held_out
    from mvrecon.methods.classical.total_variation import fista_tv as fista_tv
    from mvrecon.methods.classical.total_variation import pdhg_tv as pdhg_tv
    from mvrecon.methods.classical.tv_map import tv_map as tv_map
    from mvrecon.methods.method import finer as finer
    from mvrecon.methods.method import reconstruct as reconstruct
    from mvrecon.operators.drr import Drr as Drr
    from mvrecon.operators.operator import LinearOperator as LinearOperator
    from mvrecon.operators.radon import Radon as Radon
    from mvrecon.training.trained import load as load
    from mvrecon.training.trained import save_program as save_program
    from mvrecon.training.trained import save_weights as save_weights

__version__ = "0.2.0.dev0"

_DOOR = {
    "Cameras": "mvrecon.geometry.cameras.camera:Cameras",
    "Drr": "mvrecon.operators.drr:Drr",
    "ExplicitRays": "mvrecon.geometry.cameras.camera:ExplicitRays",
    "Grid": "mvrecon.geometry.grid:Grid",
    "LinearOperator": "mvrecon.operators.operator:LinearOperator",
    "Radon": "mvrecon.operators.radon:Radon",
    "arc": "mvrecon.geometry.cameras.rigs:arc",
    "calibrated": "mvrecon.methods.calibration.from_data:calibrated",
    "cgls": "mvrecon.methods.classical.least_squares:cgls",
    "circular": "mvrecon.geometry.cameras.rigs:circular",
    "dcspect80": "mvrecon.geometry.cameras.rigs:dcspect80",
    "dome": "mvrecon.geometry.cameras.rigs:dome",
    "epipolar_line": "mvrecon.geometry.cameras.convert:epipolar_line",
    "finer": "mvrecon.methods.method:finer",
    "fista_tv": "mvrecon.methods.classical.total_variation:fista_tv",
    "fbp": "mvrecon.methods.classical.fdk:fbp",
    "fdk": "mvrecon.methods.classical.fdk:fdk",
    "fdk_streamed": "mvrecon.methods.classical.fdk:fdk_streamed",
    "from_file": "mvrecon.geometry.cameras.files:from_file",
    "from_markers": "mvrecon.methods.calibration.markers:from_markers",
    "held_out": "mvrecon.methods.classical.stopping:held_out",
    "load": "mvrecon.training.trained:load",
    "mlem": "mvrecon.methods.classical.mlem:mlem",
    "os_sart": "mvrecon.methods.classical.sirt:os_sart",
    "osem": "mvrecon.methods.classical.mlem:osem",
    "parallel": "mvrecon.geometry.cameras.rigs:parallel",
    "pdhg_tv": "mvrecon.methods.classical.total_variation:pdhg_tv",
    "random_rig": "mvrecon.geometry.cameras.random_rigs:random_rig",
    "read_volume": "mvrecon.data.volume_files:read_volume",
    "reconstruct": "mvrecon.methods.method:reconstruct",
    "save_program": "mvrecon.training.trained:save_program",
    "save_volume": "mvrecon.data.volume_files:save_volume",
    "save_weights": "mvrecon.training.trained:save_weights",
    "sirt": "mvrecon.methods.classical.sirt:sirt",
    "tikhonov": "mvrecon.methods.classical.least_squares:tikhonov",
    "tv_map": "mvrecon.methods.classical.tv_map:tv_map",
}


def __getattr__(name: str) -> Any:
    if name not in _DOOR:
        from mvrecon.core.registry import hint

        raise AttributeError(f"mvrecon has no {name!r}{hint(name, _DOOR)}")
    module, _, attribute = _DOOR[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*_DOOR, "__version__"])
