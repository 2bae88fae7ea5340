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
    from mvrecon.calibration.from_data import calibrated as calibrated
    from mvrecon.calibration.markers import from_markers as from_markers
    from mvrecon.cameras.camera import Cameras as Cameras
    from mvrecon.cameras.dcspect80 import dcspect80 as dcspect80
    from mvrecon.cameras.epipolar import epipolar_line as epipolar_line
    from mvrecon.cameras.explicit import ExplicitRays as ExplicitRays
    from mvrecon.cameras.files import from_file as from_file
    from mvrecon.cameras.random_rigs import random_rig as random_rig
    from mvrecon.cameras.rigs import arc as arc
    from mvrecon.cameras.rigs import circular as circular
    from mvrecon.cameras.rigs import dome as dome
    from mvrecon.cameras.rigs import parallel as parallel
    from mvrecon.data.volume_files import read_volume as read_volume
    from mvrecon.data.volume_files import save_volume as save_volume
    from mvrecon.engine.program import save_program as save_program
    from mvrecon.engine.trained import load as load
    from mvrecon.engine.trained import save_weights as save_weights
    from mvrecon.geometry.grid import Grid as Grid
    from mvrecon.models.method import reconstruct as reconstruct
    from mvrecon.projectors.drr import Drr as Drr
    from mvrecon.projectors.operator import LinearOperator as LinearOperator
    from mvrecon.projectors.radon import Radon as Radon
    from mvrecon.reconstructors.bsrem import bsrem as bsrem
    from mvrecon.reconstructors.cgls import cgls as cgls
    from mvrecon.reconstructors.filtered.fdk import fbp as fbp
    from mvrecon.reconstructors.filtered.fdk import fdk as fdk
    from mvrecon.reconstructors.filtered.streaming import fdk_streamed as fdk_streamed
    from mvrecon.reconstructors.finer import finer as finer
    from mvrecon.reconstructors.fista_tv import fista_tv as fista_tv
    from mvrecon.reconstructors.held_out import held_out as held_out
    from mvrecon.reconstructors.iterative import sirt as sirt
    from mvrecon.reconstructors.mlem import mlem as mlem
    from mvrecon.reconstructors.mlem import osem as osem
    from mvrecon.reconstructors.os_sart import os_sart as os_sart
    from mvrecon.reconstructors.pdhg_tv import pdhg_tv as pdhg_tv
    from mvrecon.reconstructors.tikhonov import tikhonov as tikhonov
    from mvrecon.reconstructors.tv_map import tv_map as tv_map

__version__ = "0.2.0.dev0"

_DOOR = {
    "Cameras": "mvrecon.cameras.camera:Cameras",
    "Drr": "mvrecon.projectors.drr:Drr",
    "ExplicitRays": "mvrecon.cameras.explicit:ExplicitRays",
    "Grid": "mvrecon.geometry.grid:Grid",
    "LinearOperator": "mvrecon.projectors.operator:LinearOperator",
    "Radon": "mvrecon.projectors.radon:Radon",
    "arc": "mvrecon.cameras.rigs:arc",
    "bsrem": "mvrecon.reconstructors.bsrem:bsrem",
    "calibrated": "mvrecon.calibration.from_data:calibrated",
    "cgls": "mvrecon.reconstructors.cgls:cgls",
    "circular": "mvrecon.cameras.rigs:circular",
    "dcspect80": "mvrecon.cameras.dcspect80:dcspect80",
    "dome": "mvrecon.cameras.rigs:dome",
    "epipolar_line": "mvrecon.cameras.epipolar:epipolar_line",
    "finer": "mvrecon.reconstructors.finer:finer",
    "fista_tv": "mvrecon.reconstructors.fista_tv:fista_tv",
    "fbp": "mvrecon.reconstructors.filtered.fdk:fbp",
    "fdk": "mvrecon.reconstructors.filtered.fdk:fdk",
    "fdk_streamed": "mvrecon.reconstructors.filtered.streaming:fdk_streamed",
    "from_file": "mvrecon.cameras.files:from_file",
    "from_markers": "mvrecon.calibration.markers:from_markers",
    "held_out": "mvrecon.reconstructors.held_out:held_out",
    "load": "mvrecon.engine.trained:load",
    "mlem": "mvrecon.reconstructors.mlem:mlem",
    "os_sart": "mvrecon.reconstructors.os_sart:os_sart",
    "osem": "mvrecon.reconstructors.mlem:osem",
    "parallel": "mvrecon.cameras.rigs:parallel",
    "pdhg_tv": "mvrecon.reconstructors.pdhg_tv:pdhg_tv",
    "random_rig": "mvrecon.cameras.random_rigs:random_rig",
    "read_volume": "mvrecon.data.volume_files:read_volume",
    "reconstruct": "mvrecon.models.method:reconstruct",
    "save_program": "mvrecon.engine.program:save_program",
    "save_volume": "mvrecon.data.volume_files:save_volume",
    "save_weights": "mvrecon.engine.trained:save_weights",
    "sirt": "mvrecon.reconstructors.iterative:sirt",
    "tikhonov": "mvrecon.reconstructors.tikhonov:tikhonov",
    "tv_map": "mvrecon.reconstructors.tv_map:tv_map",
}


def __getattr__(name: str) -> Any:
    if name not in _DOOR:
        from mvrecon.registry import hint

        raise AttributeError(f"mvrecon has no {name!r}{hint(name, _DOOR)}")
    module, _, attribute = _DOOR[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted([*_DOOR, "__version__"])
