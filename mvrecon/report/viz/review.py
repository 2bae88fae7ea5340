"""Sheets for review: planes, projections, slices, views, per-view estimates and weights of cameras,
with fixed colour scales.

Convention: [d h w] = (z, y, x); letters at the edges mark the patient's right (R), left (L), front
(A), back (P), head (H) and feet (F).
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid
from mvrecon.report.viz import images
from mvrecon.report.viz.sheet import (
    BAR_STRIP,
    LINE_HEIGHT,
    TILE_GAP,
    ColourScale,
    Column,
    Layout,
    Panel,
    Tile,
    drawn,
    sheet,
)

#: Weights of rays.
RAY_WEIGHT = ColourScale(0.0, 2.0, "weight of the ray (line: full)", 1.0)
#: Maximum number of cameras on a sheet; width of a mosaic in pixels.
MAX_CAMERAS, MOSAIC_WIDTH = 8, 1400
Volumes = Mapping[str, Float[Tensor, "d h w"]]
#: What a volume's values are, by their unit.
QUANTITIES = {
    "1/mm": "attenuation",
    "HU": "CT number",
    "activity": "activity",
    "kBq/ml": "activity",
    "counts/mm^3": "activity",
}


class CaseSheets(NamedTuple):
    """Title and scales of a case's sheets.

    Args:
        name: name of the case.
        grid: grid of its volumes, which may be coarser in the same box.
        data_range: upper end of the volumes' values.
        unit: unit of the volumes.
        unit_of_views: unit of the views.
        centre: point in world mm through which its planes pass; None: the grid's centre.
    """

    name: str
    grid: Grid
    data_range: float
    unit: str = ""
    unit_of_views: str = ""
    centre: Float[Tensor, "3"] | None = None

    def about(self, volume: Float[Tensor, "d h w"], cameras: Cameras | None = None) -> "CaseSheets":
        """The case with planes through a volume's `images.content`, unless it has a centre."""
        if self.centre is not None:
            return self
        return self._replace(centre=images.content(volume, self.grid, cameras))

    @property
    def quantity(self) -> str:
        """Name of what the volumes' values are, by their unit."""
        return QUANTITIES.get(self.unit, "value")

    def value(self, share: float = 1.0, name: str | None = None) -> ColourScale:
        """Scale of values from 0 to a share of the range."""
        return ColourScale(0.0, share * self.data_range, _named(name or self.quantity, self.unit))

    def error(self, share: float, name: str = "error") -> ColourScale:
        """Scale of signed values up to a share of the range."""
        return ColourScale(
            -share * self.data_range, share * self.data_range, _named(name, self.unit)
        )

    def panels(self, volume: Float[Tensor, "d h w"], scale: ColourScale) -> list[Panel]:
        """The planes of a volume across z, y and x through the centre."""
        return self._panels(volume, images.planes(volume, self.grid, self.centre), scale)

    def brightest(self, volume: Float[Tensor, "d h w"], scale: ColourScale) -> list[Panel]:
        """The maximum-intensity projections of a volume along z, y and x."""
        return self._panels(volume, images.brightest(volume, self.grid), scale)

    def _panels(self, volume: Tensor, shown: list[images.Plane], scale: ColourScale) -> list[Panel]:
        mm = min(self.grid.spacing) * self.grid.size[0] / volume.shape[-1]
        return [Panel(plane.pixels, scale, plane.edges, mm, plane.name) for plane in shown]


def planes(
    case: CaseSheets,
    truth: Float[Tensor, "d h w"],
    volumes: Volumes,
    marked: Float[Tensor, "d h w"] | None = None,
) -> images.Image:
    """Three planes through the truth's content, of it and of every volume above its error, to
    scale.

    Values from 0 to the case's range; errors, volume - truth, to a fourth of it.

    Args:
        case: grid and range of the case.
        truth: the true values.
        volumes: volumes by name; further lines of a name, such as figures, are printed below it.
        marked: the truth with a support's outline, drawn instead.
    """
    case = case.about(truth)
    columns = _against(case, truth, volumes, 3)
    if marked is not None:
        columns[0] = Column("truth", _spread(case.panels(marked, case.value()), [None] * 3))
    return sheet(case.name, columns, _spread(_names(columns[0].panels[::2]), ["error"] * 3))


def _against(case: CaseSheets, truth: Tensor, volumes: Volumes, count: int) -> list[Column]:
    """The first planes of the truth and of every volume, each above its error."""
    value, error = case.value(), case.error(0.25, "error, volume - truth")

    def column(name: str, volume: Tensor, errors: Sequence[Panel | None]) -> Column:
        return Column(name, _spread(case.panels(volume, value)[:count], errors[:count]))

    columns = [column("truth", truth, [None] * 3)]
    for name, volume in volumes.items():
        columns.append(column(name, volume, case.panels(volume - truth, error)))
    return columns


def slices(
    case: CaseSheets, truth: Float[Tensor, "d h w"], volumes: Volumes, z: int
) -> images.Image:
    """One plane across z of the truth and of every volume above its error, to scale; see
    `planes`.
    """
    at, (_, high, wide) = slice(z, z + 1), case.grid.shape
    level = case.grid.cropped(Box((z, 0, 0), (z + 1, high, wide)))
    cut = {name: volume[at] for name, volume in volumes.items()}
    columns = _against(case._replace(grid=level, centre=None), truth[at], cut, 1)
    names = [*_names(columns[0].panels[:1]), "error"]
    return sheet(f"{case.name}, slice {z + 1} of {len(truth)}", columns, names)


def projections(case: CaseSheets, truth: Float[Tensor, "d h w"], volumes: Volumes) -> images.Image:
    """Maximum-intensity projections of the truth and of every volume along three axes, to scale."""
    scale = case.value(name=f"maximum {case.quantity}")
    columns = [
        Column(name, case.brightest(volume, scale))
        for name, volume in {"truth": truth, **volumes}.items()
    ]
    return sheet(case.name, columns, _names(columns[0].panels))


def scan(case: CaseSheets, volume: Float[Tensor, "d h w"]) -> images.Image:
    """Three planes of a volume, to scale, from 0, or the 0.5th percentile of their values if that
    is less, to the 99.5th: a hot voxel at the edge of the field would darken the rest.
    """
    shown = images.planes(volume, case.grid, case.centre)
    values = torch.cat([plane.pixels.flatten() for plane in shown]).double().nan_to_num()
    values = values[:: 1 + len(values) // 2**20]
    low, high = values.quantile(values.new_tensor([0.005, 0.995])).tolist()
    low = min(0.0, low)
    high = max(high, low + torch.finfo(torch.float32).tiny)
    panels = case._panels(volume, shown, ColourScale(low, high, _named(case.quantity, case.unit)))
    columns = [Column(panel.name, [panel]) for panel in panels]
    return sheet(case.name, columns, ("",))


def save_planes(
    path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid, unit: str = "", title: str = ""
) -> None:
    """Write three planes of a volume as a PNG image with a scale bar in mm and a colour bar, as
    `planes.png` of `mvrecon-reconstruct`; an existing file is replaced atomically.

    The planes pass through the centre of mass of the bright half of the values, in radiological
    orientation. Black is 0, or the 0.5th percentile if that is less; white the 99.5th.

    Args:
        path: path of the picture, such as "planes.png".
        volume: the values.
        grid: grid of the volume.
        unit: unit of the values: "1/mm" and "HU" are an attenuation, "activity" an activity.
        title: text above the planes.

    Examples:
        >>> grid = mv.Grid.centred(16, spacing=2.0)
        >>> mv.save_planes("planes.png", torch.rand(grid.shape), grid, unit="1/mm", title="noise")
    """
    images.save_png(path, scan(CaseSheets(title, grid, 1.0, unit).about(volume), volume))


def views(
    measured: Float[Tensor, "m v u"],
    predicted: Float[Tensor, "m v u"],
    name: str = "",
    unit: str = "",
    ray_weights: Float[Tensor, "m v u"] | None = None,
) -> images.Image:
    """Measured and predicted views of the cameras and their difference, with its NRMSE, and the
    weights of their rays, if any; at most `MAX_CAMERAS` of them, at equal steps.

    Values from 0 to the greatest measured value; the difference to a tenth of it; weights from 0 to
    2, so that a ray that counts fully is grey.
    """
    top = max(measured.amax().item(), torch.finfo(torch.float32).tiny)
    value = ColourScale(0.0, top, _named_views(unit))
    apart = ColourScale(-top / 10, top / 10, f"difference, {_named_views(unit)}")
    columns = []
    for m in _chosen(len(measured)):
        y, p = measured[m], predicted[m]
        error = ((p - y).norm() / y.norm().clamp(min=torch.finfo(torch.float32).tiny)).item()
        panels = [Panel(y, value), Panel(p, value), Panel(p - y, apart)]
        if ray_weights is not None:
            panels.append(Panel(ray_weights[m], RAY_WEIGHT))
        columns.append(Column(f"camera {m}\n{error:.3f}", panels))
    title = f"{name}: NRMSE of views{_left_out(len(columns), len(measured))}"
    rows = ("measured", "predicted", "difference", "weights")
    return sheet(title, columns, rows[: len(columns[0].panels)])


def mosaic(views: Float[Tensor, "m v u"], name: str = "", unit: str = "") -> images.Image:
    """All views in rows, from 0 to the 99.9th percentile of the values, with a colour bar: 80
    square views in 4 rows of 20. Simulated counts, which are scaled to another unit, are shown as
    counts.

    Rows are equal where that fits, about five times as long as all are high. Pixels of rows wider
    than `MOSAIC_WIDTH` are averaged. Text has twice its usual size.
    """
    views, quantity = _counted(views.detach().cpu().float(), unit)
    count, high, wide = views.shape
    across = min(
        range(1, count + 1),
        key=lambda n: -count % n + abs(math.log(n * wide / (5 * high * -(-count // n)))),
    )
    coarse = avg_pool2d(views, -(-across * wide // MOSAIC_WIDTH), ceil_mode=True)
    values = coarse.flatten()[:: 1 + coarse.numel() // 2**20]
    top = values.quantile(0.999).item() or coarse.amax().item()
    top = max(top, torch.finfo(torch.float32).tiny)
    coarse = pad(pad(coarse, (0, 1, 0, 1), value=top), (0, 0, 0, 0, 0, -count % across))
    rows = coarse.unflatten(0, (-1, across)).transpose(1, 2)
    zoom = max(1, MOSAIC_WIDTH // (across * coarse.shape[2]))
    tall, width = zoom * coarse.shape[1] / 2, zoom * across * coarse.shape[2] / 2
    panel = Panel(rows.flatten(2).flatten(0, 1), ColourScale(0.0, top, quantity))
    tile = Tile(panel, 0, LINE_HEIGHT, width, tall * len(rows))
    words = f"{name}: " * bool(name) + f"{count} views, {across} a row"
    title = {"s": words, "x": TILE_GAP, "y": LINE_HEIGHT / 2, "ha": "left"}
    return drawn(Layout([tile], [title], LINE_HEIGHT + tall * len(rows) + BAR_STRIP, width, zoom=2))


def per_view(case: CaseSheets, volumes: Float[Tensor, "m d h w"]) -> images.Image:
    """Three planes of the mean of the cameras' volumes, and of each camera's difference from it, to
    scale.

    The mean from 0 to the range; differences to an eighth of it, blue to red.
    """
    mean, apart = volumes.mean(dim=0), case.error(1 / 8, "estimate - mean")
    columns = [Column("mean", case.panels(mean, case.value(name=f"mean {case.quantity}")))]
    for m in _chosen(len(volumes), MAX_CAMERAS - 1):
        columns.append(Column(f"camera {m}", case.panels(volumes[m] - mean, apart)))
    return sheet(
        f"{case.name}: per-view estimates{_left_out(len(columns) - 1, len(volumes))}",
        columns,
        _names(columns[0].panels),
    )


def uncertainty(
    case: CaseSheets, error: Float[Tensor, "d h w"], sigma: Float[Tensor, "d h w"]
) -> images.Image:
    """Three planes of a volume's absolute error and of its estimated standard deviation, to scale,
    both from 0 to an eighth of the range.
    """
    scale = case.value(1 / 8, "|error| and sigma")
    shown = {"|error|": error.abs(), "sigma": sigma}
    columns = [Column(name, case.panels(volume, scale)) for name, volume in shown.items()]
    return sheet(f"{case.name}: |error| and its estimate", columns, _names(columns[0].panels))


def weights(case: CaseSheets, volumes: Float[Tensor, "m d h w"]) -> images.Image:
    """Three planes of every camera's weight, to scale.

    Values from 0 to 3 / M, so that an equal weight, which the colour bar marks, is at one third.
    """
    equal = 1 / len(volumes)
    scale = ColourScale(0.0, 3 * equal, f"weight (line: equal, 1/{len(volumes)})", equal)
    columns = [Column(f"camera {m}", case.panels(volumes[m], scale)) for m in _chosen(len(volumes))]
    title = f"{case.name}: weights of cameras{_left_out(len(columns), len(volumes))}"
    return sheet(title, columns, _names(columns[0].panels))


def _names(panels: Sequence[Panel | None]) -> list[str]:
    return [panel.name for panel in panels if panel is not None]


def _chosen(count: int, most: int = MAX_CAMERAS) -> list[int]:
    """The numbers of at most so many cameras, at equal steps."""
    shown = min(count, most)
    return [k * count // shown for k in range(shown)]


def _left_out(shown: int, count: int) -> str:
    """Suffix of a title if some cameras are omitted."""
    return f", {shown} of {count} cameras" if shown < count else ""


def _spread(first: Sequence, second: Sequence) -> list:
    return [item for pair in zip(first, second, strict=True) for item in pair]


def _named(name: str, unit: str) -> str:
    if unit == "activity":  # what a file or a scene states: any unit
        unit = "relative"
    return f"{name} ({unit})" if unit else name


def _named_views(unit: str) -> str:
    if unit.endswith(" * mm"):
        return _named("line integral", "" if unit == "1/mm * mm" else unit)
    if unit.endswith(" of activity"):
        return _named("counts", "scaled to the activity")
    return _named("view", unit)


def _counted(views: Float[Tensor, "m v u"], unit: str) -> tuple[Float[Tensor, "m v u"], str]:
    """Views and what their values are: counts, if they are whole multiples of the least."""
    if " of " in unit and views.any():
        counts = views / views[views > 0].min()
        if (counts - counts.round()).abs().max() < 0.1:
            return counts.round(), "counts"
    return views, _named_views(unit)


#: Pixels of `alignments`: a tile's edge, a detector's pixel, a dot's radius, a legend's line.
TILE_EDGE, PIXEL_EDGE, DOT_RADIUS, LEGEND_LINE = 172, 43, 6, 22
GREY, LIGHT, GREEN = (90, 90, 90), (200, 200, 200), (0, 190, 90)


def alignments(
    shift_px: Float[Tensor, "m 2"],
    gain: Float[Tensor, " m"],
    true_shift_px: Float[Tensor, "m 2"] | None = None,
) -> images.Image:
    """Shift of each camera in pixels as a white dot, its gain as a number, and the true shift as a
    green ring, under a legend.

    A tile's centre is an error-free camera, its circle a pixel; larger shifts are clamped to its
    edge. At most four tiles per row.

    Args:
        shift_px: estimated shifts, along columns (to the right) and rows (downwards).
        gain: estimated gains.
        true_shift_px: true shifts, along columns and rows, in pixels; None: unknown.
    """
    truths = [None] * len(gain) if true_shift_px is None else true_shift_px.tolist()
    tiles = [
        _alignment_tile(f"{m}: gain {factor:.3f}", shift, truth)
        for m, (factor, shift, truth) in enumerate(
            zip(gain.tolist(), shift_px.tolist(), truths, strict=True)
        )
    ]
    wide = min(4, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % wide)
    rows = [np.hstack(tiles[i : i + wide]) for i in range(0, len(tiles), wide)]
    words = ["dot: estimated shift", "circle: 1 pixel"]
    words += ["small ring: true shift"] * (true_shift_px is not None)
    return np.vstack([_legend(words, wide * TILE_EDGE), *rows])


def _legend(words: list[str], width: int) -> images.Image:
    """Lines of words that fit into the width."""
    from PIL import Image as Pillow, ImageDraw

    across = max(1, width // TILE_EDGE)
    lines = [words[i : i + across] for i in range(0, len(words), across)]
    legend = Pillow.new("RGB", (width, LEGEND_LINE * len(lines)))
    draw = ImageDraw.Draw(legend)
    for k, line in enumerate(lines):
        for m, text in enumerate(line):
            draw.text((TILE_EDGE * m + 1, LEGEND_LINE * k + 1), text, fill=LIGHT, font_size=15)
    return np.asarray(legend)


def _alignment_tile(name: str, shift: list[float], truth: list[float] | None) -> images.Image:
    from PIL import Image as Pillow, ImageDraw

    tile = Pillow.new("RGB", (TILE_EDGE, TILE_EDGE))
    draw, middle = ImageDraw.Draw(tile), TILE_EDGE // 2
    draw.line((0, middle, TILE_EDGE, middle), fill=GREY)
    draw.line((middle, 0, middle, TILE_EDGE), fill=GREY)
    draw.circle((middle, middle), PIXEL_EDGE, outline=GREY)
    if truth is not None:
        draw.circle(_in_tile(truth), 2 * DOT_RADIUS, outline=GREEN)
    draw.circle(_in_tile(shift), DOT_RADIUS, fill=(255, 255, 255))
    return np.vstack([_legend([name], TILE_EDGE), np.asarray(tile)])


def _in_tile(shift: list[float]) -> tuple[float, float]:
    u, v = (min(max(TILE_EDGE // 2 + PIXEL_EDGE * one, 0), TILE_EDGE - 1) for one in shift)
    return u, v
