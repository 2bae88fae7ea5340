"""The compiled loops over rays: project, back-project, and how the projections change with the geometry.

Compiled at the first call for a type of number, and kept on disk.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels import joseph, siddon
from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays import JOSEPH, at, main_axis, trace, within

#: lines [m 4 3 3], window (w0, w1), sizes (x, y, z), flat strides (x, y, z) of the padded volume, detector, method.
Rig = namedtuple("Rig", ["lines", "window", "sizes", "strides", "detector", "method"])


@scalar
def _steps(rig, axis):
    return rig.strides[(axis + 1) % 3], rig.strides[(axis + 2) % 3]


@scalar
def _buffers(rig, flat):
    slabs = max(rig.sizes)
    return np.empty((3, slabs), rig.strides.dtype), np.empty((3, slabs), flat.dtype)


@compiled
def project_rows(flat, rig, views, first, last):
    """Sum the volumes [n p] along the rays of the detector rows first to last of all views [n m v u]."""
    index, part = _buffers(rig, flat)
    rows, columns = rig.detector
    for row in range(first, last):
        m, v = row // rows, row % rows
        line = rig.lines[m]
        for u in range(columns):
            pu, pv = u - (columns - 1) / 2, v - (rows - 1) / 2
            axis = main_axis(line, pu, pv)
            ray = trace(line, axis, pu, pv, rig.window, rig.sizes, rig.method)
            count = max(0, ray.last - ray.first)
            length = flat.dtype.type(ray.length)
            if rig.method == JOSEPH:
                joseph.cells(ray, rig.strides, index, part)
                for n in range(len(flat)):
                    views[n, m, v, u] = length * joseph.sum(flat[n], _steps(rig, axis), count, index, part)
            else:
                siddon.cells(ray, rig.strides, index, part)
                for n in range(len(flat)):
                    views[n, m, v, u] = length * siddon.sum(flat[n], _steps(rig, axis), count, index, part)


@compiled
def backproject_slabs(flat, rig, views, axis, low, high):
    """Spread views [n m v u] into the slabs [low, high) of the volumes [n p], for the rays with one main axis."""
    index, part = _buffers(rig, flat)
    rows, columns = rig.detector
    for row in range(len(rig.lines) * rows):
        m, v = row // rows, row % rows
        line = rig.lines[m]
        for u in range(columns):
            pu, pv = u - (columns - 1) / 2, v - (rows - 1) / 2
            if main_axis(line, pu, pv) != axis:
                continue
            ray = within(trace(line, axis, pu, pv, rig.window, rig.sizes, rig.method), low, high)
            count = ray.last - ray.first
            if count <= 0:
                continue
            length = flat.dtype.type(ray.length)
            if rig.method == JOSEPH:
                joseph.cells(ray, rig.strides, index, part)
                for n in range(len(flat)):
                    joseph.spread(flat[n], _steps(rig, axis), count, index, part, length * views[n, m, v, u])
            else:
                siddon.cells(ray, rig.strides, index, part)
                for n in range(len(flat)):
                    siddon.spread(flat[n], _steps(rig, axis), count, index, part, length * views[n, m, v, u])


@scalar
def _pull_back(line, ray, p, window, value, slopes, change):
    """Add to a row's `change` [4 3 3] the derivative of value * (one ray's integral) by the maps in `line`."""
    total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end = slopes
    axis, b, c = ray.axis, (ray.axis + 1) % 3, (ray.axis + 2) % 3
    D = at(line, 0, axis, p[0], p[1])
    value_b, value_c = -at(line, 1, c, p[0], p[1]) / D, at(line, 1, b, p[0], p[1]) / D
    across = by_b * value_b + by_slope_b * ray.slope_b + by_c * value_c + by_slope_c * ray.slope_c
    scale = ray.length * value
    by_D = -(across + total) / D
    near, far = (window[0], window[1]) if D > 0 else (window[1], window[0])
    # an end without limit is never inside the box, and infinity times nothing is not a number
    by_D -= at_begin * near if at_begin != 0 else 0.0
    by_D += at_end * far if at_end != 0 else 0.0
    world = (ray.length * D) ** 2
    for k in range(3):
        change[0, axis, k] += scale * by_D * p[k]
        change[0, b, k] += scale * by_slope_b / D * p[k]
        change[0, c, k] += scale * by_slope_c / D * p[k]
        change[1, c, k] -= scale * by_b / D * p[k]
        change[1, b, k] += scale * by_c / D * p[k]
        change[2, axis, k] += scale * (at_end - at_begin) * p[k]
        for x in range(3):
            change[3, x, k] += scale * total * at(line, 3, x, p[0], p[1]) / world * p[k]


@compiled
def vary_rows(flat, rig, views, change, first, last):
    """Into `change` [m v 4 3 3]: per detector row, the derivative of sum(views * projections) by the maps."""
    index, part = _buffers(rig, flat)
    rows, columns = rig.detector
    for row in range(first, last):
        m, v = row // rows, row % rows
        line = rig.lines[m]
        for u in range(columns):
            p = (u - (columns - 1) / 2, v - (rows - 1) / 2, 1.0)
            axis = main_axis(line, p[0], p[1])
            ray = trace(line, axis, p[0], p[1], rig.window, rig.sizes, rig.method)
            count = max(0, ray.last - ray.first)
            for n in range(len(flat)):
                if rig.method == JOSEPH:
                    joseph.cells(ray, rig.strides, index, part)
                    slopes = joseph.slopes(flat[n], _steps(rig, axis), count, index, part, ray)
                else:
                    siddon.cells(ray, rig.strides, index, part)
                    slopes = siddon.slopes(flat[n], _steps(rig, axis), count, index, part, ray)
                _pull_back(line, ray, p, rig.window, views[n, m, v, u], slopes, change[m, v])
