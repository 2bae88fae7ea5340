"""Choice of skipped parts of a volume: searches for non-zero voxels and estimates the work on some
rays, so that skipping always pays.
"""

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from mvrecon.geometry.grid import Box, bricks_along, three
from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu.footprint import spans_of
from mvrecon.kernels.rays.cpu.plan import Scene
from mvrecon.kernels.rays.cpu.trace import empty, from_centre, main_axis, trace
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy, boxes_of
from mvrecon.kernels.threads import parallel_for

#: Bricks along an axis sampled to estimate the share of empty ones.
SOME = 6


def readable(volumes: Tensor) -> np.ndarray:
    """Volumes whose zeros are exact; halves as the integers of their bits, so that -0 counts as
    occupied.
    """
    volumes = volumes.detach().cpu()
    return (volumes.view(torch.int16) if volumes.element_size() == 2 else volumes).numpy()


def box_of(volumes: np.ndarray) -> Box:
    """The bounding box of the non-zero voxels, including NaN, of volumes [n d h w].

    Searched inwards from both sides at once, which is almost free for full volumes.
    """
    low, high = np.zeros(3, np.int64), np.array(volumes.shape[1:], np.int64)
    for axis in range(3):
        ends = np.zeros(2, np.int64)

        def find(first: int, last: int, axis: int = axis, ends: np.ndarray = ends) -> None:
            for side in range(first, last):
                ends[side] = inward(volumes, axis, side, low, high)

        parallel_for(find, 2, volumes.size)
        low[axis], high[axis] = ends
        if low[axis] >= high[axis]:
            return Box((0, 0, 0), (0, 0, 0))
    return Box(three(low), three(high))


@compiled
def inward(volumes, axis, side, low, high):
    """The bound of a box along an axis, moved inwards until its face is occupied; side 0: the lower
    one.
    """
    for step in range(high[axis] - low[axis]):
        place = high[axis] - 1 - step if side else low[axis] + step
        if _face_holds(volumes, axis, place, low, high):
            return place + side
    return low[axis] if side else high[axis]


@compiled
def _face_holds(volumes, axis, place, low, high):
    z0, z1 = (place, place + 1) if axis == 0 else (low[0], high[0])
    y0, y1 = (place, place + 1) if axis == 1 else (low[1], high[1])
    x0, x1 = (place, place + 1) if axis == 2 else (low[2], high[2])
    for n in range(len(volumes)):
        for z in range(z0, z1):
            for y in range(y0, y1):
                nonzero = 0
                for x in range(x0, x1):
                    nonzero |= np.int64(volumes[n, z, y, x] != 0)
                if nonzero:
                    return True
    return False


@compiled
def mark(volumes, low, high, bricks):
    """Set the bricks [z y x] with a non-zero voxel of the box inside or just behind."""
    for n in range(len(volumes)):
        for z in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for i in range(max(0, low[2] - 1) // EDGE, (high[2] - 1) // EDGE + 1):
                    nonzero = 0
                    for x in range(max(low[2], i * EDGE), min(high[2], i * EDGE + EDGE + 1)):
                        nonzero |= np.int64(volumes[n, z, y, x] != 0)
                    if nonzero:
                        k, j = z // EDGE, y // EDGE
                        for before_z in range(k - int(z % EDGE == 0 and z > 0), k + 1):
                            for before_y in range(j - int(y % EDGE == 0 and y > 0), j + 1):
                                bricks[before_z, before_y, i] = 1


@compiled
def sample_bricks(volumes, low, high, counts):
    """Count the empty and all of a sample of the bricks in a box."""
    steps = (_stride(low[0], high[0]), _stride(low[1], high[1]), _stride(low[2], high[2]))
    for z in range(low[0] - low[0] % EDGE, high[0], steps[0]):
        for y in range(low[1] - low[1] % EDGE, high[1], steps[1]):
            for x in range(low[2] - low[2] % EDGE, high[2], steps[2]):
                counts[0] += not _brick_holds(volumes, z, y, x)
                counts[1] += 1


@scalar
def _stride(low, high):
    return EDGE * max(1, (high - low) // EDGE // SOME)


@compiled
def _brick_holds(volumes, z0, y0, x0):
    count, depth, height, width = volumes.shape
    for n in range(count):
        for z in range(z0, min(z0 + EDGE, depth)):
            for y in range(y0, min(y0 + EDGE, height)):
                for x in range(x0, min(x0 + EDGE, width)):
                    if volumes[n, z, y, x] != 0:
                        return True
    return False


def bricks_of(volumes: np.ndarray, box: Box) -> UInt8[np.ndarray, "z y x"]:
    """The bricks of volumes [n d h w] as in an `Occupancy`, given a box with all non-zero
    voxels.
    """
    bricks = np.zeros(bricks_along(volumes.shape[1:], EDGE), np.uint8)
    if box.size:
        mark(volumes, np.array(box.low), np.array(box.high), bricks)
    return bricks


#: Slabs of all rays from which on searching for a volume's box pays; and slabs that must remain
#: with the box for bricks to pay: below, the fixed cost of a call hides their saving
#: (experiments/05_skip).
SOME, MUCH = 2**21, 3 * 2**23
#: Rays on which work is estimated.
RAYS = 1024
#: Fixed cost of a ray, and cost of testing one layer of bricks, in slabs.
SET_UP, ASK = 16.0, 3.0
#: Share of empty bricks from which on all are searched, and greatest share of the work that may
#: remain with them.
WORTH, LESS = 0.35, 0.85


def occupancy_of(volumes: Tensor, scene: Scene, skip: str) -> Occupancy:
    """The occupancy of volumes [n d h w], as detailed as `skip` requires.

    Args:
        volumes: values, or a mask.
        scene: the rays.
        skip: "box"; "brick"; "auto", the fastest if searched in every call; "once", the fastest
            without the cost of the search.
    """
    values = readable(volumes)
    shape = Box.whole(values.shape[1:]).high
    if skip == "auto" and scene.slabs(shape) < SOME:
        return Occupancy.whole(shape)
    occupancy = Occupancy(shape, box_of(values))
    box = occupancy.box
    if skip == "box" or "trilinear" in scene.method or not box.size:
        return occupancy
    if skip == "brick":
        return Occupancy(shape, box, bricks_of(values, box))
    if scene.slabs(shape) < MUCH:
        return occupancy
    counts = np.zeros(2, np.int64)
    sample_bricks(values, np.array(box.low), np.array(box.high), counts)
    if counts[0] / max(1, counts[1]) < WORTH:
        return occupancy
    # bricks, if they reduce the work enough
    bricked = Occupancy(shape, box, bricks_of(values, box))
    of_all, of_box, of_bricks = (
        work(one, scene) for one in (Occupancy.whole(shape), occupancy, bricked)
    )
    pays = of_box / of_all * scene.slabs(shape) >= MUCH and of_bricks < LESS * of_box
    shares = of_box / of_all, of_bricks / of_all
    return Occupancy(shape, box, bricked.bricks if pays else None, shares)


def work(occupancy: Occupancy, scene: Scene) -> float:
    """The mean work on a ray of the detector, in slabs."""
    rig = scene.rig(occupancy)
    # the same few rays each time, so that the choice is reproducible
    places = np.random.default_rng(0).random((RAYS, 3)) * [len(rig.lines), *rig.detector]
    chosen = places.astype(np.int64)
    views, index = np.unique(chosen[:, 0], return_inverse=True)
    chosen[:, 0] = index
    rows = np.zeros(len(views), bool)
    spans = spans_of(rig.lines[views], rig.detector, rows, boxes_of(occupancy))
    return float(count(rig._replace(lines=rig.lines[views]), spans, chosen)) / RAYS


@compiled
def count(rig, spans, chosen):
    """The work on the rays `chosen` [r 3] = (view, row, column), in slabs."""
    total = 0.0
    for r in range(len(chosen)):
        m, v, u = chosen[r]
        if len(rig.lines[m, 0, 0]) == 3 and not spans[m, v, 0] <= u < spans[m, v, 1]:
            continue
        pixel = from_centre(rig, u, v)
        axis = main_axis(rig.lines[m], pixel[0], pixel[1])
        ray = trace(rig.lines[m], axis, 0 if axis == 2 else 2, pixel, rig, rig.method)
        total += SET_UP
        low = ray.first
        while low < ray.last:
            high = min(ray.last, low // EDGE * EDGE + EDGE)
            if len(rig.bricks):
                total += ASK
            if not len(rig.bricks) or not empty(rig, ray, low, high):
                total += high - low
            low = high
    return total
