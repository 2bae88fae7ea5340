"""A ray's segments dealt out to layers of magnification, on the CPU.

The layers of a view lie at equal steps of 1 / w, the magnification of a pinhole's image but for its
sign; a segment between two of them is shared out linearly.
"""

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.lines import DIRECTION, START
from mvrecon.kernels.rays.trace import SIDDON, at


@scalar
def layer_of(rig, ray, line, pixel, layers, count, desk):
    """Write where the segments of the slabs that were visited lie among the layers of a view."""
    slab, layer, real = desk.room.four, desk.path.layer, desk.path.layer.dtype.type
    last = len(layers) - 1
    if last == 0:
        return
    D = at(line, DIRECTION, ray.axis, pixel[0], pixel[1])
    start = at(line, START, ray.axis, pixel[0], pixel[1])
    scale = last / (layers[last] - layers[0])
    for i in range(np.uint32(count)):
        along = (D / (np.float64(slab[i]) - start) - layers[0]) * scale
        between = real(min(max(along, 0.0), np.float64(last)))
        if rig.method == SIDDON:
            layer[i], layer[count + i], layer[2 * count + i] = between, between, between
        else:
            layer[i] = between


@scalar
def deal(path, count, values):
    """Add what segments send out to the layers of a pixel."""
    last = len(values) - 2
    for i in range(count):
        k = min(int(path.layer[i]), last)
        part, sent = path.layer[i] - k, path.share[i] * path.emission[i]
        values[k] += sent - part * sent
        values[k + 1] += part * sent


@scalar
def gather(path, count, values):
    """Into `value`: the value of a pixel's layers at its segments, the transpose of `deal`."""
    last = len(values) - 2
    for i in range(count):
        k = min(int(path.layer[i]), last) if last >= 0 else 0
        part = path.layer[i] - k if last >= 0 else path.layer.dtype.type(0)
        path.value[i] = (
            values[k] if last < 0 else values[k] - part * values[k] + part * values[k + 1]
        )


@scalar
def silent(views, m, v, u):
    """Whether a pixel is zero in all layers of all views [n m v u k]."""
    for n in range(len(views)):
        for k in range(views.shape[4]):
            if views[n, m, v, u, k] != 0:
                return False
    return True
