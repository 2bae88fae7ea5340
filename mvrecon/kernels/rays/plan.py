"""How the loops share out a rig: which views are read how, and the volume in which layout, piece by piece."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.padding import padded_shape
from mvrecon.kernels.rays.columns import columnar
from mvrecon.kernels.rays.lanes import LANES
from mvrecon.kernels.rays.lines import DIRECTION, START, shifted
from mvrecon.kernels.rays.loops import Rig
from mvrecon.kernels.rays.trace import JOSEPH, TRILINEAR, numbered

#: Bytes of the copy of a piece of the volume.
BUDGET = 24 * 2**20


@dataclass(frozen=True)
class Plan:
    """Which views are read how.

    Args:
        upright: indices of the views whose columns are read as rows of voxels.
        oblique: indices of the others.
        axes: whether a ray of an oblique view can have each main axis.
        lanes: volumes that lie side by side.
    """

    upright: np.ndarray
    oblique: np.ndarray
    axes: tuple[bool, bool, bool]
    lanes: int

    @property
    def layouts(self) -> list[tuple[int, tuple[bool, bool, bool]]]:
        """The near axes of the stores that are needed, each with the main axes of the rays that read it."""
        x, y, z = self.axes
        turned = [(2, (x, y, False))] if x or y or len(self.upright) else []
        return turned + ([(0, (False, False, z))] if z else [])

    def reads(self, rig: Rig, near: int) -> tuple[np.ndarray, np.ndarray]:
        """The oblique views, and which of them are tall for a near axis: its greatest steps are from row to row."""
        steps = np.abs(rig.lines[self.oblique, DIRECTION, near]) + np.abs(rig.lines[self.oblique, START, near])
        tall = steps[:, 1] > steps[:, 0] if rig.lines.shape[3] == 3 else np.zeros(len(steps), bool)
        return self.oblique, tall


def rig_of(lines: Tensor, window: Sequence[float], shape: Sequence[int], detector: Sequence[int], method: str) -> Rig:
    """What the loops know of the rays."""
    maps = np.ascontiguousarray(lines.detach().numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    sizes = (int(shape[2]), int(shape[1]), int(shape[0]))
    return Rig(maps, ends, sizes, (int(detector[0]), int(detector[1])), *numbered(method))


def plan_of(rig: Rig, volumes: int) -> Plan:
    """The plan for projecting volumes, or for back-projecting into them."""
    upright = columnar(rig) if rig.method != TRILINEAR else np.zeros(len(rig.lines), bool)
    oblique = np.flatnonzero(~upright)
    lanes = LANES if rig.method == JOSEPH and volumes > 2 else 1
    return Plan(np.flatnonzero(upright), oblique, _main_axes(rig, rig.lines[oblique, 0]), lanes)


def ray_plan_of(rig: Rig) -> Plan:
    """The plan that goes ray by ray, volume by volume, for derivatives in the geometry."""
    every = np.arange(len(rig.lines))
    return Plan(every[:0], every, _main_axes(rig, rig.lines[:, 0]), 1)


def _main_axes(rig: Rig, direction: Float[np.ndarray, "m 3 k"]) -> tuple[bool, bool, bool]:
    rows, columns = rig.detector
    corners = np.array([[u, v, 1] for u in (-1, 1) for v in (-1, 1)]) * [(columns - 1) / 2, (rows - 1) / 2, 1]
    ends = direction @ corners[:, -direction.shape[2] :].T
    # the ray of a pixel lies between those of the corners
    least = np.where(ends.min(axis=2) * ends.max(axis=2) > 0, np.abs(ends).min(axis=2), 0)
    possible = np.abs(ends).max(axis=2) * (1 + 1e-9) >= least.max(axis=1, keepdims=True)
    x, y, z = possible.any(axis=0) if len(possible) else (False, False, False)
    return bool(x), bool(y), bool(z)


def pieces(rig: Rig, volumes: int, itemsize: int) -> Iterator[tuple[slice, Rig]]:
    """Ranges of the volume's rows whose copies fit the budget, each with the rig about its own centre.

    Weights of both methods are of single voxels, so that the pieces' projections add up to the whole volume's. The
    samples of "trilinear" are spaced along the ray's way through the whole volume: it is one piece.
    """
    width, height, depth = rig.sizes
    size = volumes * math.prod(padded_shape(rig.sizes)) * itemsize
    parts = 1 if rig.method == TRILINEAR else max(1, min(height, -(-size // BUDGET)))
    for part in range(parts):  # the first is the greatest, and its memory serves the others
        low, high = -(-height * part // parts), -(-height * (part + 1) // parts)
        lines = shifted(rig.lines, (low + high - height) / 2)
        yield slice(low, high), rig._replace(lines=lines, sizes=(width, high - low, depth))
