"""The stress plan as a list: every case with every applicable part."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from mvrecon.core.options import required
from mvrecon.core.parts import REGISTRIES
from mvrecon.core.registry import hint
from mvrecon.operators.ray_transform import RAY_METHODS
from mvrecon_bench.benchmarks.cases import DTYPES
from mvrecon_bench.stresses.case import KINDS, Case
from mvrecon_bench.stresses.subject import Subject, subject_of

#: Modules of cases, in the plan's order.
FILES = (
    *("rays", "segments", "scales", "algebra", "accuracy", "derivatives"),
    *("cameras", "images", "poses", "scenes", "heads", "methods", "method_state", "counts"),
    *("line_integrals", "tensors", "dtypes", "values", "sizes", "repeatability", "gpu"),
)


def cases() -> list[Case]:
    """All cases, sorted by number.

    Raises:
        ValueError: two cases of the same kind of part have the same number.
    """
    listed = [
        case
        for file in FILES
        for case in import_module(f"mvrecon_bench.stresses.cases.{file}").CASES
    ]
    keys = [(case.number, case.kind, case.name) for case in listed]
    if len(set(keys)) < len(keys):
        raise ValueError(
            f"Two cases are the same: {sorted(key for key in set(keys) if keys.count(key) > 1)}"
        )
    return sorted(listed, key=lambda case: case.number)


def subjects(parts: str | Sequence[Any], device: str, dtypes: Sequence[str]) -> list[Subject]:
    """Build the subjects of a plan.

    Args:
        parts: "all", or names and mappings `{kind: ..., name: ..., **options}`; a bare name is
            looked up in all kinds.
        device: device of the tests.
        dtypes: names in `DTYPES`.

    Raises:
        LookupError: an unknown part, kind or dtype.
    """
    for dtype in dtypes:
        if dtype not in DTYPES:
            raise LookupError(f"No dtype is named {dtype!r}{hint(dtype, DTYPES)}")
    named = every_part() if parts == "all" else [_part(part) for part in _listed(parts)]
    return [
        subject_of(kind, name, options, device, DTYPES[dtype])
        for kind, name, options in named
        for dtype in dtypes
    ]


def every_part() -> list[tuple[str, str, dict[str, Any]]]:
    """Kind, name and options of all registered parts, including plugins, and of mvrecon itself.

    mvrecon's own projectors are included with each of their methods.
    """
    parts: list[tuple[str, str, dict[str, Any]]] = []
    for kind in KINDS[:-1]:
        for name in REGISTRIES[kind].names():
            if kind == "projector" and required(kind, name):
                continue  # such as a projector defined by a file, which is tested with that file
            ours = kind == "projector" and REGISTRIES[kind].origin(name).startswith("mvrecon.")
            parts += (
                [(kind, name, {"method": method}) for method in RAY_METHODS]
                if ours
                else [(kind, name, {})]
            )
    return [*parts, ("mvrecon", "", {})]


def jobs(subjects: Iterable[Subject], chosen: Sequence[int] = ()) -> Iterator[tuple[Case, Subject]]:
    """All pairs of case and applicable subject, optionally restricted to some case numbers."""
    every = [case for case in cases() if not chosen or case.number in chosen]
    for subject in subjects:
        for case in every:
            if case.kind == subject.kind and subject.dtype in case.dtypes:
                yield case, subject


def _listed(parts: str | Sequence[Any]) -> Sequence[Any]:
    return [parts] if isinstance(parts, str) else parts


def _part(config: str | Mapping[str, Any]) -> tuple[str, str, dict[str, Any]]:
    """Kind, name and options of one part."""
    if isinstance(config, str):
        config = {"name": config}
    options = {key: value for key, value in config.items() if key not in ("kind", "name")}
    name = config.get("name", "")
    if config.get("kind", name) == "mvrecon":
        return "mvrecon", "", {}
    kinds = (
        [config["kind"]]
        if "kind" in config
        else [kind for kind in KINDS[:-1] if name in REGISTRIES[kind].names()]
    )
    if not kinds or kinds[0] not in KINDS:
        known = [part for kind in KINDS[:-1] for part in REGISTRIES[kind].names()]
        raise LookupError(f"No part to stress is {dict(config)}{hint(name, known)}")
    REGISTRIES[kinds[0]].origin(name)
    return kinds[0], name, options
