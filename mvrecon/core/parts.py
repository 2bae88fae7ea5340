"""Locations of mvrecon's own parts as strings, so that listing them imports nothing; descriptions
of parts; types of options that name a part.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

from mvrecon.core.registry import Registry, installed
from mvrecon.core.signatures import (
    REQUIRED,
    Option,
    OptionsOf,
    PartOf,
    alternatives,
    options_of,
    options_of_section,
)

#: Options by name; a type below says whose they are, and settings are checked by it.
Options: TypeAlias = Mapping[str, Any]
ScenePart: TypeAlias = Annotated[Options, PartOf("scene")]
CameraPart: TypeAlias = Annotated[Options, PartOf("camera")]
ProjectorPart: TypeAlias = Annotated[Options, PartOf("projector")]
HeadPart: TypeAlias = Annotated[Options, PartOf("head")]
WeightingPart: TypeAlias = Annotated[Options, PartOf("weighting")]
NetworkPart: TypeAlias = Annotated[Options, PartOf("network")]
MethodPart: TypeAlias = Annotated[Options, PartOf("method")]
ClassicalPart: TypeAlias = Annotated[Options, PartOf("method", classical=True)]
ScatterPart: TypeAlias = Annotated[Options, PartOf("scatter")]
FactorsPart: TypeAlias = Annotated[Options, PartOf("factors")]

SCENES = Registry(
    "scene",
    ellipsoids="mvrecon.data.scenes.phantoms:RandomEllipsoids",
    derenzo="mvrecon.data.scenes.phantoms:RandomDerenzo",
    shepp_logan="mvrecon.data.scenes.phantoms:SheppLogan",
    mixture="mvrecon.data.scenes.sample:Mixture",
    hdf5="mvrecon.data.volumes:Hdf5Volumes",
    volumes="mvrecon.data.volumes:Volumes",
)
CAMERAS = Registry(
    "camera",
    circular="mvrecon.geometry.cameras.rigs:circular",
    arc="mvrecon.geometry.cameras.rigs:arc",
    dome="mvrecon.geometry.cameras.rigs:dome",
    random="mvrecon.geometry.cameras.random_rigs:random_rig",
    parallel="mvrecon.geometry.cameras.rigs:parallel",
    from_file="mvrecon.geometry.cameras.files:from_file",
    dcspect80="mvrecon.geometry.cameras.rigs:dcspect80",
    rtk_xml="mvrecon.geometry.cameras.formats.rtk_xml:read",
    tigre="mvrecon.geometry.cameras.formats.tigre:read",
    nikon="mvrecon.geometry.cameras.formats.nikon:read",
    astra="mvrecon.geometry.cameras.formats.astra:read",
    angles="mvrecon.geometry.cameras.formats.angles:read",
    matrices="mvrecon.geometry.cameras.formats.matrices:read",
)
PROJECTORS = Registry(
    "projector", 2, drr="mvrecon.operators.drr:Drr", radon="mvrecon.operators.radon:Radon"
)
HEADS = Registry(
    "head",
    softmax_depth="mvrecon.methods.learned.heads:SoftmaxDepth",
    density="mvrecon.methods.learned.heads:Density",
)
WEIGHTINGS = Registry("weighting", 1, unet="mvrecon.methods.learned.weightings:UNetWeighting")
NETWORKS = Registry("network", 2, unet="mvrecon.methods.learned.baselines:UNet3d")
#: Methods `method(views, A) -> Reconstruction`: modules, and functions f(A, views, **options) that
#: return a volume; see `methods/method.py`.
METHODS = Registry(
    "method",
    2,
    cross_view="mvrecon.methods.learned.cross_view:CrossView",
    world_unet="mvrecon.methods.learned.baselines:VolumeUNet",
    mean_fusion="mvrecon.methods.learned.baselines:MeanFusion",
    geometry_free="mvrecon.methods.learned.baselines:GeometryFree",
    aligned="mvrecon.methods.calibration.self_alignment:Aligned",
    uncertain="mvrecon.methods.learned.uncertain:Uncertain",
    backprojection="mvrecon.methods.classical.sirt:backprojection",
    fbp="mvrecon.methods.classical.fdk:fbp",
    fdk="mvrecon.methods.classical.fdk:fdk",
    trained="mvrecon.training.trained_method:TrainedMethod",
    sirt="mvrecon.methods.classical.sirt:sirt",
    robust_sirt="mvrecon.methods.classical.sirt:robust_sirt",
    os_sart="mvrecon.methods.classical.sirt:os_sart",
    cgls="mvrecon.methods.classical.least_squares:cgls",
    tikhonov="mvrecon.methods.classical.least_squares:tikhonov",
    fista_tv="mvrecon.methods.classical.total_variation:fista_tv",
    pdhg_tv="mvrecon.methods.classical.total_variation:pdhg_tv",
    mlem="mvrecon.methods.classical.mlem:mlem",
    osem="mvrecon.methods.classical.mlem:osem",
    finer="mvrecon.methods.method:finer",
)
#: Readers of view files, by ending: f(path, **options) -> ProjectionStack.
VIEW_FILES = Registry(
    "views",
    1,
    h5="mvrecon.data.projections.nexus:hdf5_views",
    hdf5="mvrecon.data.projections.nexus:hdf5_views",
    hdf="mvrecon.data.projections.nexus:hdf5_views",
    nxs="mvrecon.data.projections.nexus:hdf5_views",
    nx="mvrecon.data.projections.nexus:hdf5_views",
    xtekct="mvrecon.data.projections.nikon:NikonViews",
    npy="mvrecon.data.projections.arrays:NpyViews",
    mha="mvrecon.data.projections.arrays:ItkViews",
    mhd="mvrecon.data.projections.arrays:ItkViews",
    nrrd="mvrecon.data.projections.arrays:ItkViews",
)
#: Writers of volumes by ending, beside those of `save_volume`: f(path, grid, unit) -> f(volume),
#: which refuses what its file cannot hold.
VOLUME_FILES = Registry("volume", 3)
#: Readers of these volumes by ending: f(path) -> slabs and grid, as `open_volume` returns them.
VOLUME_READERS = Registry("volume_reader", 1, vgi="mvrecon.data.vgi:open_vgi")
#: Estimates of scatter in counts: f(counts, read, cameras, **options) -> views [1 1 m v u], where
#: `read(path)` gives the counts of further views of the same detectors, such as those of another
#: energy window, in the same duration; `read(path, relative=True)` also those of unknown dose, and
#: `read(path, widths_kev=(width, that of the counts))` those of an energy window.
SCATTER = Registry("scatter", 3)
#: Factors of the pixels of counts: f(views, read, cameras, **options) -> factors [m v u] and the
#: unit of the activity that they make, None for any; `views` are `MeasuredViews`, `read` as above.
FACTORS = Registry("factors", 3)
#: Further named parts of training; mvrecon's and Lightning's own callbacks and loggers are named by
#: `_target_`.
OPTIMIZERS = Registry(
    "optimizer", 1, adamw="torch.optim:AdamW", adam="torch.optim:Adam", sgd="torch.optim:SGD"
)
CALLBACKS = Registry("callback")
LOGGERS = Registry("logger")
#: Terms of the loss: f(out, batch, data_range) -> a scalar without a unit, by the name of their
#: weight; None where the reconstruction lacks what a term compares.
LOSSES = Registry(
    "loss",
    3,
    volume="mvrecon.training.losses:volume",
    common_field="mvrecon.training.losses:common_field",
    per_view_gain="mvrecon.training.losses:per_view_gain",
    cross_view="mvrecon.training.losses:cross_view",
    entry="mvrecon.training.losses:entry",
    uncertainty="mvrecon.training.losses:uncertainty",
)
#: Figures of merit: f(volume, truth, inside, data_range) -> a number, with unit and column declared
#: by `Metric`; all registered are computed.
METRICS = Registry(
    "metric",
    4,
    psnr="mvrecon.report.metrics:psnr",
    ssim="mvrecon.report.metrics:ssim",
    nrmse="mvrecon.report.metrics:nrmse",
    psnr_inside="mvrecon.report.metrics:psnr_inside",
    ssim_inside="mvrecon.report.metrics:ssim_inside",
    nrmse_inside="mvrecon.report.metrics:nrmse_inside",
    view_nrmse="mvrecon.report.metrics:view_nrmse",
)

REGISTRIES = {
    r.kind: r for r in (SCENES, CAMERAS, PROJECTORS, HEADS, WEIGHTINGS, NETWORKS, METHODS)
}
#: Registries of `mvrecon-list`: parts that a config names by `name`, further parts of training, and
#: readers of views.
LISTED = REGISTRIES | {
    r.kind: r
    for r in (
        OPTIMIZERS,
        CALLBACKS,
        LOGGERS,
        LOSSES,
        METRICS,
        VIEW_FILES,
        VOLUME_FILES,
        VOLUME_READERS,
        SCATTER,
        FACTORS,
    )
}


@dataclass(frozen=True)
class Part:
    """Description of one part: `catch_all` allows further options, `is_class` distinguishes classes
    from functions; `error` is the reason why it cannot be imported.
    """

    kind: str
    name: str
    origin: str
    summary: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)
    catch_all: bool = False
    is_class: bool = False
    error: str = ""


def describe(kind: str, name: str) -> Part:
    """Import one part and describe it; `error` if it has no such name or does not import."""
    registry, origin = LISTED[kind], ""
    try:
        origin = registry.origin(name)
        owner = registry.get(name)
    except (LookupError, ImportError) as error:
        return Part(kind, name, origin, error=str(error))
    is_class = inspect.isclass(owner)
    # a method's class is built from its options, and called with what a function is passed
    passed = 0 if kind == "method" and is_class else registry.passed
    options, catch_all = options_of(owner, passed)
    for point in installed():
        if point.name == f"{kind}.{name}" and point.dist is not None:
            origin += f" ({point.dist.name} {point.dist.version})"
    summary = " ".join(inspect.cleandoc(owner.__doc__ or "").partition("\n\n")[0].split())
    return Part(kind, name, origin, summary, options, catch_all, is_class)


def required(kind: str, name: str) -> list[str]:
    """The options of a part that have no default, such as the path of a file."""
    return [key for key, o in describe(kind, name).options.items() if o.default is REQUIRED]


def describe_section(name: str, type: Any) -> Part:
    """Describe a section of settings by its type, as a part of the kind "setting"."""
    ((_, metadata),) = alternatives(type)
    (section,) = [mark for mark in metadata if isinstance(mark, OptionsOf)]
    options, _ = options_of_section(section)
    summary = f"The options of `{name}.` in a configuration."
    return Part("setting", name, section.owners[0], summary, options)
