# The names of `mvrecon`: type checkers read this file, and `__init__.py` imports from it lazily.
from mvrecon.data.scenes.sample import phantom as phantom
from mvrecon.data.volume_files import read_volume as read_volume, save_volume as save_volume
from mvrecon.geometry.cameras.camera import Cameras as Cameras, ExplicitRays as ExplicitRays
from mvrecon.geometry.cameras.convert import epipolar_line as epipolar_line
from mvrecon.geometry.cameras.coverage import coverage as coverage, fit_detector as fit_detector
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
from mvrecon.methods.classical.sirt import (
    os_sart as os_sart,
    robust_sirt as robust_sirt,
    sirt as sirt,
)
from mvrecon.methods.classical.stopping import held_out as held_out
from mvrecon.methods.classical.total_variation import fista_tv as fista_tv, pdhg_tv as pdhg_tv
from mvrecon.methods.method import finer as finer, reconstruct as reconstruct
from mvrecon.operators.drr import Drr as Drr
from mvrecon.operators.operator import LinearOperator as LinearOperator
from mvrecon.operators.radon import Radon as Radon
from mvrecon.report.metrics import nrmse as nrmse
from mvrecon.report.viz.review import save_planes as save_planes
from mvrecon.training.program import save_program as save_program
from mvrecon.training.trained import load as load, save_weights as save_weights

__version__: str

def __dir__() -> list[str]: ...
