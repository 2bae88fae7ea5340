"""A rig, its rays and its grid as line segments, and as a mesh of triangles for viewers without
lines.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid

#: Colours by part, red, green and blue up to 255; view 0 is the red one, as in `viz.rig`.
COLOURS = {
    "view 0": (200, 30, 30),
    "cameras": (70, 110, 190),
    "rays": (150, 150, 150),
    "grid": (0, 130, 70),
}
#: About so many cameras are drawn, and the part of the scene's extent that a line is wide.
VIEWS, WIDTH = 40, 0.003
Segments = Float[Tensor, "n 2 3"]


class Mesh(NamedTuple):
    """Triangles.

    Args:
        vertices: world mm.
        colours: of the vertices, red, green and blue up to 255.
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
        cameras: the rig, of which about `VIEWS` cameras are drawn.
        grid: whose box is drawn; none by default.
    """
    rig = cameras.to("cpu")
    chosen = sorted({0, *range(0, len(rig), max(1, len(rig) // VIEWS))})
    corners, starts = outlines(rig)
    arm = 0.02 * (corners.flatten(0, 1).amax(0) - corners.flatten(0, 1).amin(0)).max()
    frames = torch.stack([corners, corners.roll(-1, dims=1)], dim=2)
    crosses = _crosses(starts, arm)
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
    width = WIDTH * (points.amax(dim=0) - points.amin(dim=0)).max()
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
    colours = [torch.tensor(COLOURS[name]).expand(6 * len(s), 3) for name, s in parts.items()]
    return Mesh(vertices, torch.cat(colours), faces.reshape(-1, 3))


def outlines(rig: Cameras) -> tuple[Float[Tensor, "m 4 3"], Float[Tensor, "m k 3"]]:
    """Corners of each detector in world mm: first pixel, end of the first row, opposite corner, end
    of the first column; and where rays start: k = 4 points of a parallel beam, else the source.
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
    """Where the drawn rays end: at the detector, or behind the grid's middle as seen from a pinhole
    or a vision camera.
    """
    if grid is None or rig.extent not in ("behind", "ahead"):
        return corners
    far = 1.5 * (grid.centre - rig.source).norm(dim=1) / rig.distance
    sign = -1.0 if rig.extent == "behind" else 1.0
    return starts + sign * far[:, None, None] * (corners - starts)


def _crosses(points: Float[Tensor, "m k 3"], arm: Tensor) -> Float[Tensor, "m n 2 3"]:
    arms = arm * torch.eye(3).to(points)
    return torch.stack([points[:, :, None] - arms, points[:, :, None] + arms], dim=3).flatten(1, 2)


def box(grid: Grid) -> Segments:
    """The twelve edges of a grid's box in world mm."""
    corners = grid.corners()  # in the order of three binary digits
    pairs = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    return corners[torch.tensor(pairs)]
