"""Performance targets of the operators, from the rows of a benchmark: met, missed, or not
measured.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mvrecon_bench.benchmarks.report import markdown
from mvrecon_bench.benchmarks.rows import Row, number

OURS = ("drr", "radon")
HALF = ("float16", "bfloat16")


@dataclass(frozen=True)
class RowFigures:
    """The figures of a benchmark's rows.

    Args:
        rows: rows of one benchmark.
        base: column -> value of the base case of the targets.
    """

    rows: Sequence[Row]
    base: Mapping[str, Any]

    def __call__(self, part: str, method: str | None, column: str, **changes: Any) -> float:
        """The figure of a part with default options except method and back end, on the base case
        with changes; NaN if there is none.
        """
        wanted = {**self.base, **changes, "part": part, **({"method": method} if method else {})}
        for row in self.rows:
            if _plain(row) and all(row.get(name) == value for name, value in wanted.items()):
                return number(row, column)
        return math.nan

    def worst(self, figure: Callable[[Row], float], **wanted: Any) -> float:
        """Maximum of a figure over the rows of our own compiled parts with these values; NaN if
        there is none.
        """
        rows = (r for r in self.rows if r.get("part") in OURS and r.get("backend") != "reference")
        figures = [
            figure(row)
            for row in rows
            if all(row.get(name) == value for name, value in wanted.items())
        ]
        return max((f for f in figures if f == f), default=math.nan)


@dataclass(frozen=True)
class Target:
    """A figure, its upper limit, and the stretch goal."""

    text: str
    figure: Callable[[RowFigures], float]
    most: float
    goal: float | None = None


def _plain(row: Row) -> bool:
    options = json.loads(row["options"]) if row.get("options") else {}
    return (
        row.get("status") == "ok"
        and row.get("backend") != "reference"
        and not set(options) - {"method", "backend"}
    )


def _beyond_output(row: Row) -> float:
    """MB required by a call besides its input and output."""
    size = (8 if row.get("dtype") == "float64" else 4) / 2**20
    forward = number(row, "peak_mb") - size * number(row, "rays")
    adjoint = number(row, "adjoint_peak_mb") - size * number(row, "n") ** 3
    return max((f for f in (forward, adjoint) if f == f), default=math.nan)


def _against(part: str, method: str | None, column: str) -> Callable[[RowFigures], float]:
    """Ratio of Joseph's figure to another part's."""
    return lambda at: at("drr", "joseph", column) / at(part, method, column)


def _joseph(over: str, under: str) -> Callable[[RowFigures], float]:
    """Ratio of two of Joseph's figures."""
    return lambda at: at("drr", "joseph", over) / at("drr", "joseph", under)


def _grown(
    column: str, name: str, more: int, less: int, **on: Any
) -> Callable[[RowFigures], float]:
    """Ratio of Joseph's figure for a larger amount of work to that for a smaller one."""
    return lambda at: (
        at("drr", "joseph", column, **{name: more}, **on)
        / at("drr", "joseph", column, **{name: less}, **on)
    )


def _unmatched(dtype: str) -> Callable[[RowFigures], float]:
    return lambda at: at.worst(lambda row: number(row, "adjointness"), dtype=dtype)


#: On the base case of `bench=operators`, on a CPU.
CPU = (
    Target("joseph forward / RTK's", _against("rtk", None, "forward_ms"), 1 / 3, 1 / 5),
    Target("joseph forward / nanodrr's", _against("nanodrr", None, "forward_ms"), 1 / 50, 1 / 80),
    Target("joseph adjoint / RTK's", _against("rtk", None, "adjoint_ms"), 1 / 3, 1 / 6),
    Target("joseph adjoint / forward", _joseph("adjoint_ms", "forward_ms"), 2),
    Target(
        "siddon forward / joseph's", lambda at: 1 / _against("drr", "siddon", "forward_ms")(at), 1.5
    ),
    Target(
        "joseph geometry VJP / forward", lambda at: _joseph("pose_grad_ms", "forward_ms")(at) - 1, 3
    ),
    Target("joseph forward, 256^3 / 128^3", _grown("forward_ms", "n", 256, 128), 12),
    Target("joseph adjoint, 256^3 / 128^3", _grown("adjoint_ms", "n", 256, 128), 12),
)

#: On the base case of `bench=operators`, on a GPU.
GPU = (
    Target("joseph forward / nanodrr's", _against("nanodrr", None, "forward_ms"), 1 / 2),
    Target(
        "joseph forward and backward / nanodrr's",
        _against("nanodrr", None, "volume_grad_ms"),
        1 / 2,
    ),
    Target(
        "joseph error on the pixel average / nanodrr's", _against("nanodrr", None, "error_pixel"), 1
    ),
    Target("joseph adjoint / forward", _joseph("adjoint_ms", "forward_ms"), 2),
    Target(
        "joseph, 80 views, 256^3, ms",
        lambda at: at("drr", "joseph", "forward_ms", n=256, views=80),
        4,
    ),
)

#: On any device.
ACCURACY = (
    Target(
        "joseph error on the pixel average / siddon's",
        _against("drr", "siddon", "error_pixel"),
        1.03,
    ),
    Target(
        "joseph error on the pixel average / trilinear's",
        _against("drr", "trilinear", "error_pixel"),
        0.92,
    ),
    Target("adjointness, float32, worst", _unmatched("float32"), 1e-5),
    Target("adjointness, float64, worst", _unmatched("float64"), 1e-12),
    Target("NaN or infinite values", lambda at: at.worst(lambda row: number(row, "nans")), 0),
    Target("memory beyond input and output, MB, worst", lambda at: at.worst(_beyond_output), 64),
)

#: Of `bench=scaling`.
SCALING = (
    Target(
        "joseph forward, 4 channels / 1", _grown("forward_ms", "channels", 4, 1, axis="channels"), 2
    ),
    Target(
        "joseph adjoint, 4 channels / 1", _grown("adjoint_ms", "channels", 4, 1, axis="channels"), 2
    ),
)


def _greatest(
    figure: Callable[[Row], float],
    scene: str,
    tasks: Sequence[str],
    modes: Sequence[str] = ("auto",),
) -> Callable[[RowFigures], float]:
    """Maximum of a figure of `bench=skip` on a scene over all rigs and methods; NaN if there is
    none.
    """
    wanted = (("scene", [scene]), ("task", tasks), ("mode", modes))

    def found(at: RowFigures) -> float:
        figures = [
            figure(row)
            for row in at.rows
            if all(row.get(name) in values for name, values in wanted)
        ]
        return max((f for f in figures if f == f), default=math.nan)

    return found


def _time_over(column: str) -> Callable[[Row], float]:
    return lambda row: 1 / number(row, column)


_CALLS = ("forward", "forward_static", "adjoint")
_EXACT = ("auto", "box", "brick", "verify")

#: Of `bench=skip`: worst case of mode auto over all rigs and methods; for differing values, of
#: every mode.
SKIP = (
    *(
        Target(
            f"{scene}, {task}: time / off's on the {what}",
            _greatest(_time_over(column), scene, [task]),
            most,
        )
        for scene in ("derenzo", "ventricle")
        for task in _CALLS
        for what, column, most in (
            ("full cube", "over_full", 1 / 8),
            ("cropped volume", "over_crop", 1 / 1.25),
        )
    ),
    Target(
        "head_neck, cross_view: time / off's on the full cube",
        _greatest(_time_over("over_full"), "head_neck", ["cross_view"]),
        1 / 3,
    ),
    Target(
        "head_neck, cross_view: PSNR lost, dB",
        _greatest(lambda row: number(row, "psnr_loss"), "head_neck", ["cross_view"]),
        0.1,
    ),
    Target(
        "full, operators: time / off's", _greatest(_time_over("over_full"), "full", _CALLS), 1.05
    ),
    *(
        Target(
            f"{scene}, forward: values that differ from off's",
            _greatest(lambda row: number(row, "differing"), scene, _CALLS[:2], _EXACT),
            0,
        )
        for scene in ("derenzo", "ventricle", "head_neck", "torso35", "torso80", "full")
    ),
)


def table(targets: Sequence[Target], rows: Sequence[Row], base: Mapping[str, Any]) -> str:
    """The targets as a Markdown table."""
    at = RowFigures(rows, base)
    lines = []
    for target in targets:
        figure = target.figure(at)
        verdict = (
            "not measured" if figure != figure else "met" if figure <= target.most else "missed"
        )
        goal = "" if target.goal is None else f"{target.goal:.3g}"
        lines.append(
            (
                target.text,
                "" if figure != figure else f"{figure:.3g}",
                f"{target.most:.3g}",
                goal,
                verdict,
            )
        )
    return markdown(("target", "measured", "at most", "goal", "verdict"), lines)
