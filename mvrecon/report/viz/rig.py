"""Pictures of a rig and its grid: projections to scale, line segments in the world, and a triangle
mesh for viewers without lines.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit
from mvrecon.report.viz.images import Image, save_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D


#: Pixels of `picture`: a panel's edge, its margins on the left and below, and the edge of its axes.
PANEL_EDGE, PANEL_LEFT, PANEL_BELOW, PANEL_AXES = 440, 84, 58, 332
#: Approximate number of views in `picture` and as lines; width of the mesh's lines relative to the
#: scene.
DRAWN_VIEWS, DRAWN_LINES, LINE_WIDTH = 24, 40, 0.003
#: Panels: their row and column, world axes to the right and upwards, and the title. Panels with a
#: common axis are beside each other; the fourth has the legend.
PANELS = (
    ((0, 0), (0, 1), "from above (+z towards you)"),
    ((1, 0), (0, 2), "from the side, along +y"),
    ((1, 1), (1, 2), "from the side, along -x"),
)
#: Colours of `picture`: view 0, other sources and detectors, grid, directions of columns and rows,
#: rays and axes.
FIRST_COLOUR, SOURCE_COLOUR, OTHER_COLOUR, BOX_COLOUR = "#c81e1e", "#202020", "#7896c8", "#006e3c"
U_COLOUR, V_COLOUR, RAY_COLOUR = "#e67800", "#9600aa", "#aaaaaa"
#: What the dots of `picture` are, by the extent of the rays.
SOURCE_NAMES = {"segment": "source", "behind": "pinhole", "ahead": "camera"}


@torch.no_grad()
def picture(cameras: Cameras, grid: Grid | None = None) -> Image:
    """Draw a rig and a grid in three projections to scale, with axes in mm, and a legend.

    Sources (pinholes) are black dots, detectors blue outlines; view 0 is red, with its edge rays,
    which pass a pinhole into the grid, and lines from pixel (0, 0) along its columns (u, orange)
    and rows (v, violet); view 1 has a ring, which shows the sense of rotation. The grid's box is
    green. Of many views about `DRAWN_VIEWS` are drawn.

    Args:
        cameras: the rig.
        grid: grid whose box is drawn; none by default.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    rig = _near(cameras.to("cpu"), grid)
    chosen = sorted({0, min(1, len(rig) - 1), *range(0, len(rig), max(1, len(rig) // DRAWN_VIEWS))})
    corners, starts = (part[chosen] for part in outlines(rig))
    edges = torch.empty(0, 2, 3).to(corners) if grid is None else box(grid)
    ends = _reached(rig[:1], starts[:1], corners[:1], grid)
    rays = torch.stack([corners[0], starts[0].expand(4, 3), ends[0]], dim=1)
    points = torch.cat([part.flatten(0, 1) for part in (corners, starts, edges)])
    low, high = points.aminmax(dim=0)
    centre = ((low + high) / 2).tolist()
    reach = 1.05 * max((high - low).max().item() / 2, 1e-9)
    width = 2 * PANEL_EDGE
    with rc_context({"font.size": 11, "axes.titlesize": "medium"}):
        figure = Figure((width / 100, width / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        for (row, column), (right, up), title in PANELS:
            left, below = PANEL_EDGE * column + PANEL_LEFT, PANEL_EDGE * (1 - row) + PANEL_BELOW
            share = PANEL_AXES / width
            axes = figure.add_axes((left / width, below / width, share, share))
            for line in (axes.axhline, axes.axvline):
                line(0, color=RAY_COLOUR, linewidth=0.8)
            views = zip(chosen, starts[..., [right, up]], corners[..., [right, up]], strict=True)
            for m, start, outline in views:
                _draw_camera(axes, m, start.numpy(), outline.numpy())
            for ray in rays[..., [right, up]]:
                axes.plot(*ray.T.numpy(), color=RAY_COLOUR, linewidth=0.8)
            sides = list(edges[..., [right, up]].numpy())
            axes.add_collection(LineCollection(sides, colors=BOX_COLOUR, linewidths=1.5))
            axes.set(
                title=title,
                xlabel=f"{'xyz'[right]} / mm",
                ylabel=f"{'xyz'[up]} / mm",
                xlim=(centre[right] - reach, centre[right] + reach),
                ylim=(centre[up] - reach, centre[up] + reach),
            )
            axes.locator_params(nbins=5)
            axes.yaxis.labelpad = 0
        figure.legend(
            handles=_signs(SOURCE_NAMES.get(rig.extent, "source")),
            title=f"{len(chosen)} of {len(rig)} views",
            loc="center",
            bbox_to_anchor=(0.5, 0.5, 0.5, 0.5),
            frameon=False,
        )
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _signs(start: str) -> list["Line2D"]:
    """Entries of the legend; `start` is what the dots are."""
    from matplotlib.lines import Line2D

    signs: dict[str, dict[str, Any]] = {
        start: {"color": SOURCE_COLOUR, "marker": "o", "markersize": 4, "linewidth": 0},
        "detector": {"color": OTHER_COLOUR, "linewidth": 1},
        "view 0": {"color": FIRST_COLOUR, "linewidth": 1.5},
        "edge rays of view 0": {"color": RAY_COLOUR, "linewidth": 0.8},
        "view 1": {
            "color": SOURCE_COLOUR,
            "marker": "o",
            "markersize": 10,
            "fillstyle": "none",
            "linewidth": 0,
        },
        "u, from pixel (0, 0) along its row": {"color": U_COLOUR, "linewidth": 3},
        "v, from pixel (0, 0) along its column": {"color": V_COLOUR, "linewidth": 3},
        "grid, which is reconstructed": {"color": BOX_COLOUR, "linewidth": 1.5},
    }
    return [Line2D([], [], label=label, **style) for label, style in signs.items()]


def _draw_camera(
    axes: "Axes", m: int, starts: Float[np.ndarray, "k 2"], corners: Float[np.ndarray, "4 2"]
) -> None:
    """Draw the source and the detector of view m, in mm; of view 0 also its directions."""
    source, detector = (FIRST_COLOUR, FIRST_COLOUR) if m == 0 else (SOURCE_COLOUR, OTHER_COLOUR)
    front = 3 if m == 0 else 2
    width = 1.5 if m == 0 else 1
    axes.fill(*corners.T, fill=False, edgecolor=detector, linewidth=width, zorder=front)
    axes.plot(*starts.T, "o", color=source, markersize=4, zorder=front)
    if m == 1:
        axes.plot(*starts[0], "o", color=source, markersize=10, fillstyle="none")
    if m == 0:
        for end, hue in ((corners[1], U_COLOUR), (corners[3], V_COLOUR)):
            line = np.array([corners[0], corners[0] + 0.6 * (end - corners[0])])
            axes.plot(*line.T, "o-", color=hue, markevery=[1], linewidth=3, zorder=4)


def save_picture(path: str | Path, cameras: Cameras, grid: Grid | None = None) -> None:
    """Write `picture` as a PNG, atomically."""
    save_png(path, picture(cameras, grid))


#: Colours of parts, red, green and blue up to 255; view 0 is red, as in `picture`.
MESH_COLOURS = {
    "view 0": (200, 30, 30),
    "cameras": (70, 110, 190),
    "rays": (150, 150, 150),
    "grid": (0, 130, 70),
}
Segments = Float[Tensor, "n 2 3"]


class Mesh(NamedTuple):
    """Triangles.

    Args:
        vertices: corners in world mm.
        colours: colour of each vertex: red, green and blue up to 255.
        faces: indices of three vertices each.
    """

    vertices: Float[Tensor, "n 3"]
    colours: Int[Tensor, "n 3"]
    faces: Int[Tensor, "k 3"]


@torch.no_grad()
def segments(cameras: Cameras, grid: Grid | None = None) -> dict[str, Segments]:
    """Line segments in world mm by part: "view 0" and "cameras" (sources as crosses, detectors as
    outlines), "rays" (the edges of view 0's beam, and the central ray of the others), "grid" (its
    box).

    Args:
        cameras: the rig, about `DRAWN_LINES` of whose cameras are drawn.
        grid: grid whose box is drawn; none by default.
    """
    rig = _near(cameras.to("cpu"), grid)
    chosen = sorted({0, *range(0, len(rig), max(1, len(rig) // DRAWN_LINES))})
    corners, starts = outlines(rig)
    arm = 0.02 * (corners.flatten(0, 1).amax(0) - corners.flatten(0, 1).amin(0)).max()
    frames = torch.stack([corners, corners.roll(-1, dims=1)], dim=2)
    arms, at = arm * torch.eye(3).to(starts), starts[:, :, None]
    crosses = torch.stack([at - arms, at + arms], dim=3).flatten(1, 2)
    rays = torch.stack([starts.expand_as(corners), _reached(rig, starts, corners, grid)], dim=2)
    others = chosen[1:]
    parts = {
        "view 0": torch.cat([frames[0], crosses[0]]),
        "cameras": torch.cat([frames[others].flatten(0, 1), crosses[others].flatten(0, 1)]),
        "rays": torch.cat([rays[0], rays[others].mean(dim=1)]),
    }
    if grid is not None:
        parts["grid"] = box(grid)
    return parts


def mesh(parts: dict[str, Segments]) -> Mesh:
    """Triangles that draw segments as thin three-sided rods in the colours of their parts."""
    ends = torch.cat(list(parts.values()))
    points = ends.flatten(0, 1)
    width = LINE_WIDTH * (points.amax(dim=0) - points.amin(dim=0)).max()
    along = ends[:, 1] - ends[:, 0]
    least = torch.eye(3).to(along)[along.abs().argmin(dim=1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(along, least), dim=1)
    second = torch.nn.functional.normalize(torch.linalg.cross(along, first), dim=1)
    angles = torch.arange(3).to(along) * (2 * torch.pi / 3)
    rim = first[:, None] * angles.cos()[:, None] + second[:, None] * angles.sin()[:, None]
    vertices = (ends[:, :, None] + width / 2 * rim[:, None]).reshape(-1, 3)
    sides = [(k, (k + 1) % 3, 3 + k) for k in range(3)]
    sides += [((k + 1) % 3, 3 + (k + 1) % 3, 3 + k) for k in range(3)]
    faces = torch.tensor(sides) + 6 * torch.arange(len(ends))[:, None, None]
    colours = [torch.tensor(MESH_COLOURS[name]).expand(6 * len(s), 3) for name, s in parts.items()]
    return Mesh(vertices, torch.cat(colours), faces.reshape(-1, 3))


def _near(rig: Cameras, grid: Grid | None) -> Cameras:
    """Parallel beams without an end, drawn from the grid on as far as it and detectors are wide, to
    scale with them; other rigs as they are.
    """
    if grid is None or not rig.parallel or rig.extent != "line":
        return rig
    rows, columns = rig.shape
    panel = (rig.u * columns).norm(dim=1) + (rig.v * rows).norm(dim=1)
    low, high = grid.corners().to(panel).aminmax(dim=0)
    reach = panel.max() + (high - low).norm()
    way = unit(rig.origin - rig.source)
    beside = ((grid.centre.to(way) - rig.detector_centre) * way).sum(dim=1, keepdim=True) * way
    middle = rig.origin + beside
    return replace(rig, source=middle - reach * way, origin=middle + reach * way)


def outlines(rig: Cameras) -> tuple[Float[Tensor, "m 4 3"], Float[Tensor, "m k 3"]]:
    """Corners of each detector in world mm: first pixel, end of the first row, opposite corner, end
    of the first column; and starts of rays: k = 4 points of a parallel beam, else the source.
    """
    rows, columns = rig.shape
    steps = rig.origin.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    ends = steps * steps.new_tensor([columns, rows]) - 0.5
    across = ends[:, :1] * rig.u[:, None] + ends[:, 1:] * rig.v[:, None]
    starts = rig.source[:, None] + (across if rig.parallel else torch.zeros_like(across[:, :1]))
    return rig.origin[:, None] + across, starts


def _reached(
    rig: Cameras, starts: Float[Tensor, "m k 3"], corners: Float[Tensor, "m 4 3"], grid: Grid | None
) -> Float[Tensor, "m 4 3"]:
    """Ends of the drawn rays: at the detector, or behind the grid's centre for a pinhole or a
    vision camera.
    """
    if grid is None or rig.extent not in ("behind", "ahead"):
        return corners
    far = 1.5 * (grid.centre - rig.source).norm(dim=1) / rig.distance
    sign = -1.0 if rig.extent == "behind" else 1.0
    return starts + sign * far[:, None, None] * (corners - starts)


def box(grid: Grid) -> Segments:
    """The twelve edges of a grid's box in world mm."""
    corners = grid.corners()  # in the order of three binary digits
    pairs = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    return corners[torch.tensor(pairs)]
