"""Execution plans of the loops: order and memory layout for each view, in pieces of the volume."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.grid import Box, Three
from mvrecon.kernels.rays.cpu.columns import columnar
from mvrecon.kernels.rays.cpu.footprint import spans_of
from mvrecon.kernels.rays.cpu.trace import LANES, Columns, Reads, Rig, bounds_of, rig_of
from mvrecon.kernels.rays.lines import DIRECTION, START, TRILINEAR, shifted
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy, boxes_of, bricks_of_rig
from mvrecon.kernels.rows import padded_shape

#: Bytes of the copy of a piece of the volume.
BUDGET = 24 * 2**20
#: Number of cached plans, and maximum lines, and rows or columns of pixels, of a cached plan: for
#: larger ones planning takes a negligible time.
PLANS, SMALL = 64, 2**14


class Scene(NamedTuple):
    """The rays of a call, as in the operators' arguments."""

    lines: Tensor
    window: Sequence[float]
    detector: Sequence[int]
    method: str

    def slabs(self, shape: Sequence[int]) -> int:
        """Maximum number of slabs over all rays."""
        return len(self.lines) * math.prod(self.detector) * max(shape)

    def rig(self, occupancy: Occupancy) -> Rig:
        """The rig in the loops' form, about the occupied part of the volume."""
        return rig_of(self.lines, self.window, occupancy, self.detector, self.method)


@dataclass(frozen=True, eq=False)
class Plan:
    """The processing of each view; its arrays are read-only, as threads share them.

    Args:
        rig: arguments of the loops.
        upright: views processed by detector columns and rows of voxels.
        oblique: indices of the others.
        axes: possible main axes of rays in oblique views.
        lanes: number of adjacent volumes.
        boxes: occupied boxes, see `footprint.spans_of`.
        pieces: see `pieces`.
    """

    rig: Rig
    upright: Columns
    oblique: np.ndarray
    axes: tuple[bool, bool, bool]
    lanes: int
    boxes: Float[np.ndarray, "n 6"] | None
    pieces: tuple[tuple[slice, Rig], ...]

    @property
    def layouts(self) -> list[tuple[int, tuple[bool, bool, bool]]]:
        """The required layouts of the volume: the near axis of a store, and the main axes of the
        oblique rays that read it.
        """
        x, y, z = self.axes
        turned = [(2, (x, y, False))] if x or y or len(self.upright.views) else []
        return turned + ([(0, (False, False, z))] if z else [])

    @property
    def units(self) -> int:
        """Number of units of the oblique views, see `loops.ray_span`."""
        return len(self.oblique) * max(self.rig.detector)

    @cached_property
    def reads(self) -> dict[int, Reads]:
        """Processing of oblique views for each near axis; a view is tall if steps between rows are
        greatest along that axis.
        """
        return {near: self._reads(near) for near, _ in self.layouts}

    def _reads(self, near: int) -> Reads:
        lines = self.rig.lines[self.oblique]
        steps = np.abs(lines[:, DIRECTION, near]) + np.abs(lines[:, START, near])
        tall = steps[:, 1] > steps[:, 0] if lines.shape[3] == 3 else np.zeros(len(steps), bool)
        return Reads(self.oblique, tall, spans_of(lines, self.rig.detector, tall, self.boxes))


def plan_of(scene: Scene, occupancy: Occupancy, volumes: int, itemsize: int) -> Plan:
    """The plan for projecting volumes, with so many bytes a number, or for back-projecting.

    Plans of small scenes are cached, as iterations repeat the call.
    """
    lanes = LANES if scene.method == "joseph" and volumes > 2 else 1
    parts = parts_of(scene.method, occupancy.shape, volumes * itemsize)
    units = len(scene.lines) * max(scene.detector)
    if occupancy.bricks is None and max(units, scene.lines.numel()) <= SMALL:
        maps = np.ascontiguousarray(scene.lines.detach().numpy(), dtype=np.float64)
        first, last = map(float, scene.window)
        rows, columns = map(int, scene.detector)
        return kept_plan(
            *(maps.tobytes(), maps.shape, (first, last), (rows, columns), scene.method),
            *(occupancy.shape, occupancy.box, lanes, parts),
        )
    return _made(scene.rig(occupancy), occupancy, lanes, parts)


def plan_by_content(
    lines: bytes,
    shape: tuple[int, ...],
    window: tuple[float, float],
    detector: tuple[int, int],
    method: str,
    volume: Three,
    box: Box,
    lanes: int,
    parts: int,
) -> Plan:
    """The plan as a function of all its inputs; `lines` are the bytes of float64 numbers of a shape
    [m 4 3 k].
    """
    maps = torch.from_numpy(np.frombuffer(lines).reshape(shape).copy())
    occupancy = Occupancy(volume, box)
    return _made(Scene(maps, window, detector, method).rig(occupancy), occupancy, lanes, parts)


kept_plan = lru_cache(maxsize=PLANS)(plan_by_content)


def ray_plan_of(scene: Scene, occupancy: Occupancy, parts: int = 1) -> Plan:
    """A plan of single rays and volumes, in so many pieces of the volumes."""
    rig = scene.rig(occupancy)
    return _plan(rig, occupancy, np.zeros(len(rig.lines), bool), 1, parts)


def _made(rig: Rig, occupancy: Occupancy, lanes: int, parts: int) -> Plan:
    upright = columnar(rig) if rig.method != TRILINEAR else np.zeros(len(rig.lines), bool)
    return _plan(rig, occupancy, upright, lanes, parts)


def _plan(
    rig: Rig, occupancy: Occupancy, upright: Bool[np.ndarray, " m"], lanes: int, parts: int
) -> Plan:
    oblique, boxes, columns = np.flatnonzero(~upright), boxes_of(occupancy), np.flatnonzero(upright)
    tall = np.ones(len(columns), bool)
    return Plan(
        rig,
        Columns(columns, spans_of(rig.lines[columns], rig.detector, tall, boxes)),
        oblique,
        _main_axes(rig, rig.lines[oblique, 0]),
        lanes,
        boxes,
        tuple(pieces(rig, occupancy, parts)),
    )


def _main_axes(rig: Rig, direction: Float[np.ndarray, "m 3 k"]) -> tuple[bool, bool, bool]:
    rows, columns = rig.detector
    corners = np.array([[u, v, 1] for u in (-1, 1) for v in (-1, 1)]) * [
        (columns - 1) / 2,
        (rows - 1) / 2,
        1,
    ]
    corners = (
        corners[:1] if direction.shape[2] == 1 else corners
    )  # an explicit ray is its own corner
    # [corner axis view], so that numpy loops over the views innermost
    ends = np.stack(
        [direction.transpose(1, 0, 2) @ corner for corner in corners[:, -direction.shape[2] :]]
    )
    # the ray of a pixel lies between those of the corners
    least = np.where(ends.min(axis=0) * ends.max(axis=0) > 0, np.abs(ends).min(axis=0), 0)
    x, y, z = (np.abs(ends).max(axis=0) * (1 + 1e-9) >= least.max(axis=0)).any(axis=1)
    return bool(x), bool(y), bool(z)


def parts_of(method: str, shape: Sequence[int], itemsize: int) -> int:
    """Number of pieces in which volumes [d h w] are read, with so many bytes per voxel.

    One for "trilinear", whose samples are spaced along the ray's way through the whole volume.
    """
    if "trilinear" in method:
        return 1
    return max(1, -(-math.prod(padded_shape(shape)) * itemsize // BUDGET))


def pieces(rig: Rig, occupancy: Occupancy, parts: int) -> Iterator[tuple[slice, Rig]]:
    """Ranges of the volume's rows, at most `parts`, each with the rig about its own centre.

    Weights of both methods are of single voxels, so the pieces' projections add up to the whole
    volume's. The occupied box shortens pieces but never moves them, which keeps the order of sums.
    """
    width, height, depth = rig.sizes
    rows = (
        -(-height // (parts * EDGE)) * EDGE
    )  # the first is the largest, and the others reuse its memory
    for low in range(0, height, rows):
        high = min(low + rows, height)
        part = occupancy.rows(low, high)
        if part.box.size:
            lines = shifted(rig.lines, (low + high - height) / 2)
            sizes, bounds = (width, high - low, depth), bounds_of(part)
            yield (
                slice(low, high),
                Rig(lines, *rig[1:2], sizes, *rig[3:6], bounds, *bricks_of_rig(part)),
            )
