"""Error against time of methods, as an SVG picture that needs no library."""

import math
from collections.abc import Sequence
from html import escape

from mvrecon.report.comparison.rows import RISING, Row

#: Width and height of the picture and its margins, in pixels.
WIDTH, HEIGHT, LEFT, BOTTOM, RIGHT, TOP = 760, 440, 70, 50, 200, 20


def front(rows: Sequence[Row], figure: str) -> list[Row]:
    """The methods that no other one beats in both time and error, the fastest first; never one that
    has failed in a scene.
    """
    best, chosen = math.inf, []
    for row in sorted(rows, key=lambda row: (row.ms, _loss(row, figure))):
        if _loss(row, figure) < best:
            best = _loss(row, figure)
            chosen.append(row)
    return chosen


def picture(rows: Sequence[Row], figure: str = "psnr") -> str:
    """Every method at its milliseconds (logarithmic) and its figure of merit where that is finite,
    with a line along those that none other beats in both; SVG.

    Raises:
        ValueError: no method with a time and a figure.
    """
    timed = [row for row in rows if row.ms > 0]
    shown = [row for row in timed if math.isfinite(row.mean(figure))]
    if not shown:
        raise ValueError(f"Expected methods with a time and a {figure}, got none")
    x = _scale([math.log10(row.ms) for row in shown], LEFT, WIDTH - RIGHT)
    y = _scale([row.mean(figure) for row in shown], HEIGHT - BOTTOM, TOP)
    places = {id(row): (x(math.log10(row.ms)), y(row.mean(figure))) for row in shown}
    best = [places[id(row)] for row in front(timed, figure) if id(row) in places]
    line = " ".join("{:.1f},{:.1f}".format(*place) for place in best)
    parts = [f'<polyline points="{line}" fill="none" stroke="#c44" stroke-dasharray="4 3"/>']
    for row in shown:
        across, down = places[id(row)]
        label = escape(
            f"{row.method} ({row.run})" if len({r.run for r in rows}) > 1 else row.method
        )
        parts.append(f'<circle cx="{across:.1f}" cy="{down:.1f}" r="4" fill="#26c"/>')
        parts.append(_words(across + 7, down + 4, label, "start"))
        parts.append(_words(across, HEIGHT - BOTTOM + 18, f"{row.ms:.3g}", "middle"))
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(_words(middle, HEIGHT - 8, "time of a reconstruction, ms", "middle"))
    for value in (min(r.mean(figure) for r in shown), max(r.mean(figure) for r in shown)):
        parts.append(_words(LEFT - 8, y(value) + 4, f"{value:.4g}", "end"))
    parts.append(_words(LEFT - 8, TOP + 2, escape(figure), "end"))
    frame = f'<path d="M{LEFT} {TOP}V{HEIGHT - BOTTOM}H{WIDTH - RIGHT}" fill="none" stroke="#444"/>'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
    )
    return "\n".join([head, frame, *parts, "</svg>", ""])


def _loss(row: Row, figure: str) -> float:
    mean = row.mean(figure)
    if math.isnan(mean):
        return math.inf
    return -mean if figure in RISING else mean


def _scale(values: Sequence[float], start: float, end: float):
    """A linear map of the values' range, widened by a tenth, to pixels."""
    low, high = min(values), max(values)
    margin = 0.1 * (high - low) or 1.0
    return lambda v: start + (end - start) * (v - low + margin) / (high - low + 2 * margin)


def _words(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'
