"""Joseph's method, one step of a ray: in a slab of the main axis, bilinear in the two other axes.

P. M. Joseph, An improved algorithm for reprojecting rays through pixel images, IEEE Trans. Med.
Imaging 1, 1982.

`real` and `whole` are the types of weights and of flat indices.
"""

from typing import Any, NamedTuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.pose_gradient import Slopes


class Cell(NamedTuple):
    """A bilinear cell: its lower corner along the far and the near axis, and the place in it
    towards the upper one.
    """

    iy: Any
    iz: Any
    y: Any
    z: Any


class Course(NamedTuple):
    """Where a ray runs, see `trace.Ray`, in the type of weights."""

    b: Any
    slope_b: Any
    c: Any
    slope_c: Any
    begin: Any
    end: Any
    centre: Any


@scalar
def course_of(ray, real):
    """The course of a ray."""
    b, slope_b, c, slope_c = real(ray.b), real(ray.slope_b), real(ray.c), real(ray.slope_c)
    return Course(b, slope_b, c, slope_c, real(ray.begin), real(ray.end), real(ray.centre))


@scalar
def overlap(begin, end, s, half):
    """The length of a ray from begin to end in the slab about s, in voxels; half = 0.5 as a number
    of their type.
    """
    return min(end, s + half) - max(begin, s - half)


@scalar
def split(place, real):
    """The lower neighbour of a padded place along an axis, and the weight of the upper one."""
    cell = np.int32(place)
    return cell, place - real(cell)


@scalar
def cell(course, s, real):
    """The bilinear cell that a ray meets at s."""
    iy, y = split(course.b + s * course.slope_b, real)
    iz, z = split(course.c + s * course.slope_c, real)
    return Cell(iy, iz, y, z)


@scalar
def hat(t, one):
    """The weight of a voxel at the distance t along an axis, in voxels: that of `split`."""
    return max(one - one, one - abs(t))


@scalar
def face(low, beside_low, high, beside_high, y, z):
    """The bilinear value at the place (y, z) between four corners, and its slopes along the far and
    the near axis.
    """
    low_z, high_z = beside_low - low, beside_high - high
    lower, upper = low + z * low_z, high + z * high_z
    return lower + y * (upper - lower), upper - lower, low_z + y * (high_z - low_z)


@scalar
def face_at(flat, k, steps, y, z):
    """`face` of the cell at the flat index k."""
    above, near = k + steps.far, steps.near
    return face(flat[k], flat[k + near], flat[above], flat[above + near], y, z)


@scalar
def bent(sums, course, s, share, place):
    """Slopes with those of one more slab, at s, of which the ray has a share; place as `face` has
    it.
    """
    value, slope_b, slope_c = place
    half, none = type(s)(0.5), type(s)(0)
    along_b, along_c = share * slope_b, share * slope_c
    return Slopes(
        sums.total + share * value,
        sums.by_b + along_b,
        sums.by_slope_b + s * along_b,
        sums.by_c + along_c,
        sums.by_slope_c + s * along_c,
        sums.at_begin + (value if s - half < course.begin else none),
        sums.at_end + (value if s + half > course.end else none),
    )


@scalar
def in_double(sums):
    """Slopes in double precision, as those of the other methods are."""
    return Slopes(
        *(np.float64(sums.total), np.float64(sums.by_b), np.float64(sums.by_slope_b)),
        *(np.float64(sums.by_c), np.float64(sums.by_slope_c)),
        *(np.float64(sums.at_begin), np.float64(sums.at_end)),
    )
