"""mvrecon's own parts, as strings, so that listing them imports nothing; and the callbacks and
loggers that a config names, built from allowed classes by `_target_` and from installed plugins by
`name`. They write inside the run folder.
"""

import inspect
import os
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import shown
from mvrecon.core.registry import Registry

SCENES = Registry(
    "scene",
    ellipsoids="mvrecon.data.scenes.phantoms:RandomEllipsoids",
    derenzo="mvrecon.data.scenes.phantoms:RandomDerenzo",
    defrise="mvrecon.data.scenes.phantoms:Defrise",
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
    astra="mvrecon.geometry.cameras.formats.astra:read",
    angles="mvrecon.geometry.cameras.formats.angles:read",
    matrices="mvrecon.geometry.cameras.formats.matrices:read",
)
PROJECTORS = Registry(
    "projector",
    drr="mvrecon.operators.drr:Drr",
    radon="mvrecon.operators.radon:Radon",
)
HEADS = Registry(
    "head",
    softmax_depth="mvrecon.methods.learned.heads:SoftmaxDepth",
    density="mvrecon.methods.learned.heads:Density",
)
NETWORKS = Registry(
    "network",
    unet="mvrecon.methods.learned.baselines:UNet3d",
)
#: Methods `method(views, A) -> Reconstruction`: modules, and functions f(A, views, **options) that
#: return a volume; see `models/method.py`.
METHODS = Registry(
    "method",
    cross_view="mvrecon.methods.learned.cross_view:CrossView",
    world_unet="mvrecon.methods.learned.baselines:WorldUNet",
    mean_fusion="mvrecon.methods.learned.baselines:MeanFusion",
    geometry_free="mvrecon.methods.learned.baselines:GeometryFree",
    aligned="mvrecon.methods.calibration.self_alignment:Aligned",
    uncertain="mvrecon.methods.learned.uncertain:Uncertain",
    backprojection="mvrecon.methods.classical.sirt:backprojection",
    fbp="mvrecon.methods.classical.fdk:fbp",
    fdk="mvrecon.methods.classical.fdk:fdk",
    trained="mvrecon.training.trained_method:TrainedMethod",
    sirt="mvrecon.methods.classical.sirt:sirt",
    os_sart="mvrecon.methods.classical.sirt:os_sart",
    cgls="mvrecon.methods.classical.least_squares:cgls",
    tikhonov="mvrecon.methods.classical.least_squares:tikhonov",
    fista_tv="mvrecon.methods.classical.total_variation:fista_tv",
    pdhg_tv="mvrecon.methods.classical.total_variation:pdhg_tv",
    mlem="mvrecon.methods.classical.mlem:mlem",
    osem="mvrecon.methods.classical.mlem:osem",
    tv_map="mvrecon.methods.classical.tv_map:tv_map",
    finer="mvrecon.methods.method:finer",
)
#: The reconstructors that read the views block by block: f(read, cameras, grid, **options).
STREAMED = Registry(
    "streamed reconstructor",
    fdk="mvrecon.methods.classical.fdk:fdk_streamed",
)
#: Files of views that are read as one array, by their endings: f(path) -> ProjectionStack.
VIEW_FILES = Registry(
    "views",
    h5="mvrecon.data.projections.stack:Hdf5Views",
    hdf5="mvrecon.data.projections.stack:Hdf5Views",
    npy="mvrecon.data.projections.stack:NpyViews",
    mha="mvrecon.data.projections.stack:ItkViews",
    mhd="mvrecon.data.projections.stack:ItkViews",
    nrrd="mvrecon.data.projections.stack:ItkViews",
)
#: What corrects views before they are reconstructed: f(A, views, **options) -> CorrectedViews.
CORRECTIONS = Registry(
    "correct",
    align="mvrecon.methods.calibration.self_alignment:self_aligned",
)
#: What a training takes by name besides its parts; of callbacks and loggers mvrecon's own and
#: Lightning's are named by `_target_`.
OPTIMIZERS = Registry(
    "optimizer", adamw="torch.optim:AdamW", adam="torch.optim:Adam", sgd="torch.optim:SGD"
)
CALLBACKS = Registry("callback")
LOGGERS = Registry("logger")
#: Terms of the loss: f(out, batch, data_range) -> a scalar, by the name of their weight.
LOSSES = Registry("loss")
#: Figures of merit: f(volume, truth, inside, data_range) -> a number, of all that are there.
METRICS = Registry("metric")

REGISTRIES = {
    r.kind: r
    for r in (
        SCENES,
        CAMERAS,
        PROJECTORS,
        HEADS,
        NETWORKS,
        METHODS,
        CORRECTIONS,
    )
}
#: All that `mvrecon-list` shows: besides the parts that a configuration names by `name`, what a
#: training takes by name, and readers of views.
LISTED = REGISTRIES | {
    r.kind: r for r in (OPTIMIZERS, CALLBACKS, LOGGERS, LOSSES, METRICS, STREAMED, VIEW_FILES)
}

#: Where the classes that a `_target_` may name are defined, and what they must be.
ALLOWED = ("lightning.pytorch", "mvrecon.training")
BASES = ("lightning.pytorch.callbacks.Callback", "lightning.pytorch.loggers.Logger")


def instantiate(
    node: Mapping[str, Any], folder: Path, known: Registry = CALLBACKS, **options: Any
) -> Any:
    """Build the callback or the logger that a node's `_target_` names, or without one its `name`,
    with the node's other entries as options.

    Args:
        node: `_target_` or `name`, and options; places among these, such as `dirpath`, are taken
            from `folder`.
        folder: the run folder, out of which nothing is written.
        known: what plugins brought, by name; the user installed these, so that data may name them.
        options: further options, which are trusted.

    Raises:
        LookupError: an unknown name.
        TypeError: neither a target nor a name.
        PermissionError: the target is not a class of that kind that is defined below one of
            `ALLOWED`, every run has it already, or the options hold instructions of Hydra's such as
            another target, or lead out of the folder.
    """
    key = "_target_" if "_target_" in node else "name"
    if key not in node:
        raise TypeError(f"A {known.kind} needs a _target_ or a name, got {shown(sorted(node))}")
    entries = {option: value for option, value in node.items() if option != key}
    if instructions := _instructions(entries):
        raise PermissionError(
            f"{shown(instructions)} in the options of a _target_ is not allowed; expected plain "
            f"values"
        )
    make = _allowed(str(node[key])) if key == "_target_" else known.get(str(node[key]))
    made = make(**placed(entries, folder), **options)
    check_places(made, folder)
    return made


def _instructions(node: Any) -> list[str]:
    if isinstance(node, Mapping):
        keys = [str(key) for key in node if str(key).startswith("_")]
        return keys + [key for value in node.values() for key in _instructions(value)]
    return (
        [key for value in node for key in _instructions(value)]
        if isinstance(node, list | tuple)
        else []
    )


def _allowed(target: str) -> type:
    """The class that a target names. Its bases and its module decide, not the name: a name may lead
    out of a module (`a.b.os.system`), and a function of an allowed library may call any other.
    """
    cls = _attribute(target) if target.startswith(tuple(f"{name}." for name in ALLOWED)) else None
    if isinstance(cls, type) and issubclass(cls, tuple(map(_attribute, BASES))):
        if getattr(cls, "of_every_run", False):
            raise PermissionError(
                f"_target_ {target!r} is not allowed; expected none that every run has already"
            )
        if cls.__module__.startswith(tuple(f"{name}." for name in ALLOWED)):
            return cls
    raise PermissionError(
        f"_target_ {target!r} is not allowed; expected a class from {' or '.join(ALLOWED)} "
        f"derived from "
        f"{' or '.join(BASES)}"
    )


def _attribute(target: str) -> Any:
    module, _, name = target.rpartition(".")
    try:
        return getattr(import_module(module), name, None)
    except ModuleNotFoundError:
        return None


#: Options whose value is a file or a folder of its own; `sub_dir` is one below another.
PLACE = re.compile(r"(?!sub_dir$)(.*_)?(dir|dirpath|path)")
#: Places that a logger of Lightning works out of several options.
LOGS = ("save_dir", "root_dir", "log_dir")
#: Addresses of files that are no paths: file:x, memory://x, simplecache::x; those of a web service
#: write no file here.
ADDRESS = re.compile(r"(?!https?://)(file:|.*(:/|::))")


def inside(path: str | os.PathLike[str], folder: Path, what: str) -> Path:
    """Resolve the links of a path and check that it lies inside a folder.

    Args:
        path: to a file or a folder, there or not.
        folder: the run folder.
        what: leads there, for the message.

    Raises:
        PermissionError: it lies elsewhere.
    """
    resolved = Path(path).resolve()
    if not resolved.is_relative_to(folder.resolve()):
        raise PermissionError(
            f"{what} leads to {resolved}; expected a place inside the run folder {folder}"
        )
    return resolved


def placed(options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Options of a callback or a logger, each place among them (`dirpath`, `save_dir`, ...) taken
    from a folder.

    Raises:
        PermissionError: a text that would lead elsewhere, under whatever name: an absolute path,
            `..`, `~`, an address.
    """
    return {key: _placed(str(key), value, folder) for key, value in options.items()}


def _placed(key: str, value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        return placed(value, folder)
    if isinstance(value, list | tuple):
        return [_placed(key, item, folder) for item in value]
    if not isinstance(value, str):
        return value
    steps = re.split(r"[/\\]", value)
    if ".." in steps or value.startswith("~") or Path(value).anchor or ADDRESS.match(value):
        raise PermissionError(
            f"The option {key}={shown(value)} leads elsewhere; expected a place inside the run "
            f"folder {folder}"
        )
    return str(folder / value) if PLACE.fullmatch(key) else value


def check_places(thing: Any, folder: Path) -> None:
    """Check every path that a callback or a logger would write to.

    Raises:
        PermissionError: one of them lies outside the folder.
    """
    names = [name for name in inspect.signature(type(thing)).parameters if PLACE.fullmatch(name)]
    for name in dict.fromkeys((*names, *LOGS)):
        place = getattr(thing, name, None)
        if isinstance(place, str | os.PathLike) and str(place):
            inside(place, folder, f"{name} of {type(thing).__name__}")
