"""How a ray's integral changes with the geometry: from its place in the volume to the maps of its
view.
"""

from typing import Any, NamedTuple

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.trace import at, crossing


class Slopes(NamedTuple):
    """How a ray's sum changes with its place.

    The sum, in voxels of the main axis; its derivatives by b, slope_b, c, slope_c, see
    `trace.Ray`; the volume where the ray begins and ends inside the box.
    """

    total: Any
    by_b: Any
    by_slope_b: Any
    by_c: Any
    by_slope_c: Any
    at_begin: Any
    at_end: Any


@scalar
def pull_back(line, ray, p, window, value, slopes, change):
    """Add to a row's `change` [4 3 k] the derivative of value * (one ray's integral) by the maps in
    `line`, at the pixel p = (u, v, 1).
    """
    axis, b, c = ray.axis, ray.far, ray.near
    D = at(line, 0, axis, p[0], p[1])
    value_b, value_c = crossing(line, axis, b, p[0], p[1]), crossing(line, axis, c, p[0], p[1])
    across = (
        slopes.by_b * value_b
        + slopes.by_slope_b * ray.slope_b
        + slopes.by_c * value_c
        + slopes.by_slope_c * ray.slope_c
    )
    scale = ray.length * value
    by_D = -(across + slopes.total) / D
    near, far = (window[0], window[1]) if D > 0 else (window[1], window[0])
    # an end without limit is never inside the box, and infinity times nothing is not a number
    by_D -= slopes.at_begin * near if slopes.at_begin != 0 else 0.0
    by_D += slopes.at_end * far if slopes.at_end != 0 else 0.0
    world = (ray.length * D) ** 2
    turn_b = 1.0 if (b + 1) % 3 == axis else -1.0
    first = 3 - line.shape[2]
    for k in range(first, 3):
        change[0, axis, k - first] += scale * by_D * p[k]
        change[0, b, k - first] += scale * slopes.by_slope_b / D * p[k]
        change[0, c, k - first] += scale * slopes.by_slope_c / D * p[k]
        change[1, c, k - first] += turn_b * scale * slopes.by_b / D * p[k]
        change[1, b, k - first] -= turn_b * scale * slopes.by_c / D * p[k]
        change[2, axis, k - first] += scale * (slopes.at_end - slopes.at_begin) * p[k]
        for x in range(3):
            along = at(line, 3, x, p[0], p[1])
            change[3, x, k - first] += scale * slopes.total * along / world * p[k]
