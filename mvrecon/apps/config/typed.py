"""Check the names, options and types of all parts in plain settings, before anything heavy is
imported.
"""

from collections.abc import Mapping
from typing import Any

from mvrecon.core.files.checks import shown
from mvrecon.core.parts import LOSSES, REGISTRIES
from mvrecon.core.quantities import fits, in_words
from mvrecon.core.registry import check_options, hint
from mvrecon.core.signatures import SECTIONS, Option, describe, options_of, parts_in

LENGTH = "PositiveInt | Literal[-1]"
#: Types of settings that no signature of ours has.
WRITTEN = {
    "camera.detector": {
        "pixels": "PositiveInt | Pair[PositiveInt] | None",
        "pixel_mm": "PositiveFloat | Pair[PositiveFloat] | None",
        "offset_mm": "float | Pair[float] | None",
    },
    "grid": {"like": "str"},
    "data": {"overlap": "bool", "sizes": ""},
    "data.sizes": dict.fromkeys(("train", "val", "test"), "NonNegativeInt"),
    "optimizer": {
        "lr": "PositiveFloat",
        "weight_decay": "NonNegativeFloat",
        "momentum": "NonNegativeFloat",
        "schedule": "Literal['cosine', 'one_cycle', 'constant']",
        "warmup": "NonNegativeFloat",
    },
    "trainer": {
        "max_steps": LENGTH,
        "max_epochs": LENGTH,
        "num_nodes": "PositiveInt",
        "devices": "PositiveInt | Literal[-1] | str | Sequence[NonNegativeInt]",
        "accumulate_grad_batches": "PositiveInt",
        "gradient_clip_val": "NonNegativeFloat | None",
        "val_check_interval": "PositiveInt | PositiveFloat | None",
        "log_every_n_steps": "NonNegativeInt",
    },
}
#: Sections that have options of torch's and Lightning's besides.
OPEN_ENDED = ("optimizer", "trainer")


def check_parts(settings: Mapping[str, Any]) -> None:
    """Check every part that the settings name against its source: the name, the options, and the
    values whose type, range and length are known; those of the grid, the data, the acquisition,
    the loss, the optimiser and the trainer, too.

    A name or an option that the modules of `plugins` may bring is left to them.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that a part does not have, or a value of another type.
    """
    _check_sections(settings)
    for path, kind, node in parts_in(settings):
        registry, name = REGISTRIES[kind], node["name"]
        if _later(name):
            continue
        if name not in registry.names():
            if settings.get("plugins"):
                continue
            raise LookupError(f"{path}.name: no {kind} is {name!r}{hint(name, registry.names())}")
        options = {key: value for key, value in node.items() if key != "name"}
        if path.endswith(".start"):
            options.pop("finer_grid", None)
        if path == "method" or path.rpartition(".")[0] == "compare":
            _check_assumed(path, options.pop("assume", None), settings.get("projector"))
        _check_options(path, kind, name, options)


def _check_sections(settings: Mapping[str, Any]) -> None:
    """Check the settings that are no parts, such as those of the grid."""
    known = {section: dict(options_of(section)) for section in SECTIONS}
    for section, types in WRITTEN.items():
        known.setdefault(section, {}).update({key: Option(type=t) for key, t in types.items()})
    known["loss"] |= dict.fromkeys(LOSSES.names(), Option(type="float"))
    open_ended = (*OPEN_ENDED, "loss") if settings.get("plugins") else OPEN_ENDED
    for section, options in known.items():
        node: Any = settings
        for key in section.split("."):
            node = node.get(key) if isinstance(node, Mapping) else None
        if not isinstance(node, Mapping):
            continue
        if section not in open_ended:
            check_options(section, node, options)
        for key, value in node.items():
            if value is not None or section != "grid":  # null: chosen by the app
                _check_type(f"{section}.{key}", value, options.get(key, Option()))


def _check_options(path: str, kind: str, name: str, options: Mapping[str, Any]) -> None:
    part = describe(kind, name)
    if part.error:
        return  # whoever builds it says what is wrong
    if path.endswith(".start") and part.is_class:
        raise TypeError(f"{path}.name: expected a classical method, got the learned one {name!r}")
    if not part.catch_all:
        check_options(f"{path} (the {kind} {name!r})", options, part.options)
    for key, value in options.items():
        _check_type(f"{path}.{key}", value, part.options.get(key, Option()))


def _check_assumed(path: str, assumed: Any, projector: Mapping[str, Any] | None) -> None:
    """Check what a method takes the projector for: some of its options."""
    if assumed is None or not projector or "name" not in projector:
        return
    if not isinstance(assumed, Mapping):
        raise TypeError(f"{path}.assume: expected options of the projector, got {shown(assumed)}")
    part = describe("projector", projector["name"])
    if not part.error and not part.catch_all:
        where = f"{path}.assume (the projector {projector['name']!r})"
        check_options(where, assumed, part.options)


def _check_type(path: str, value: Any, option: Option) -> None:
    if _later(value):
        return
    if not fits(value, option.type):
        text = f" ({option.text})" if option.text else ""
        raise TypeError(f"{path}: expected {in_words(option.type)}, got {shown(value)}{text}")


def _later(value: Any) -> bool:
    """Whether a setting has its value from another one, or is not given yet."""
    return isinstance(value, str) and (value == "???" or "${" in value)
