"""What to leave out of a volume: counted on some rays, so that nothing is skipped that does not
pay.
"""

import numpy as np
from torch import Tensor

from mvrecon.geometry.box import Box
from mvrecon.kernels.compiling import compiled
from mvrecon.kernels.rays.cpu.footprint import spans_of
from mvrecon.kernels.rays.cpu.nonzero import box_of, bricks_of, empty_share, readable
from mvrecon.kernels.rays.cpu.plan import Scene
from mvrecon.kernels.rays.cpu.summation import empty
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy, boxes_of
from mvrecon.kernels.rays.trace import from_centre, main_axis, trace

#: Slabs of all rays from which on it is worth while to look for a volume's box; and slabs that the
#: box must leave, so that bricks gain: below, what a call costs besides its slabs hides what they
#: save (experiments/05_skip).
SOME, MUCH = 2**21, 3 * 2**23
#: Rays on which work is counted.
RAYS = 1024
#: What a ray costs before its first slab, and what it costs to ask for one layer of bricks, in
#: slabs.
SET_UP, ASK = 16.0, 3.0
#: The share of empty bricks from which on all of them are looked at, and the part of the work that
#: they must leave.
WORTH, LESS = 0.35, 0.85


def occupancy_of(volumes: Tensor, scene: Scene, skip: str) -> Occupancy:
    """Where volumes [n d h w] are not zero, as fine as `skip` says.

    Args:
        volumes: what is looked at, or a mask.
        scene: the rays.
        skip: "box"; "brick"; "auto", what costs least if it is looked for in every call; "once",
            what costs least.
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
    if scene.slabs(shape) < MUCH or empty_share(values, box) < WORTH:
        return occupancy
    return cheapest(occupancy, Occupancy(shape, box, bricks_of(values, box)), scene)


def cheapest(occupancy: Occupancy, bricked: Occupancy, scene: Scene) -> Occupancy:
    """The bricks of a box if by them rays have so much less to do that it pays, else the box; with
    the shares of the work that either leaves.
    """
    whole, box, bricks = (
        work(occupied, scene) for occupied in (Occupancy.whole(occupancy.shape), occupancy, bricked)
    )
    much = box / whole * scene.slabs(occupancy.shape) >= MUCH
    chosen = bricked if much and bricks < LESS * box else occupancy
    return Occupancy(occupancy.shape, occupancy.box, chosen.bricks, (box / whole, bricks / whole))


def work(occupancy: Occupancy, scene: Scene) -> float:
    """The mean work on a ray of the detector, in slabs."""
    rig = scene.rig(occupancy)
    # the same few rays each time: a choice must not change from call to call
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
