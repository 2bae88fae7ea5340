# numba.cuda declares what kernels see as stubs without types
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false
# pyright: reportOptionalSubscript=false
"""The kernels of the CUDA back end, in Python: numba compiles them for a device, its simulator runs
them without one.

Rays and their steps are computed by the very functions of the CPU (`trace.py`, `methods/`). One
thread follows one ray, or owns one voxel; several volumes share its index work. A kernel is made
for a method, a number of volumes and a type of flat indices, which are constants in it.
"""

from collections import namedtuple
from functools import cache

import numpy as np
from numba import cuda

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cuda import gather
from mvrecon.kernels.rays.methods import joseph, siddon, trilinear
from mvrecon.kernels.rays.methods.strides import Steps, Values
from mvrecon.kernels.rays.pose_gradient import pull_back
from mvrecon.kernels.rays.projection_matrix import projection_matrix
from mvrecon.kernels.rays.trace import (
    JOSEPH,
    SIDDON,
    TRILINEAR,
    from_centre,
    main_axis,
    trace,
)

#: Threads of a block, and the tile of the detector, columns by rows, that they share.
BLOCK, TILE = 128, (16, 8)
#: Volumes that share a thread.
GROUP = 4
#: The steps of each method.
METHODS = {JOSEPH: joseph, SIDDON: siddon, TRILINEAR: trilinear}

#: What a kernel knows of the scene, all numbers: sizes (x, y, z) of the volume; strides (x, y, z)
#: and size of what is stored of it, padded; detector (rows, columns), tile (columns, rows), window,
#: samples a ray; box, see `trace.Space`; how far its first voxel lies behind the volume's in the
#: store.
Scene = namedtuple(
    "Scene", ["sizes", "strides", "size", "detector", "tile", "window", "samples", "box", "origin"]
)


@scalar
def steps_of(scene, axis):
    """How a ray of a main axis steps through the padded volume."""
    near = gather.near_of(axis)
    return Steps(
        scene.strides[axis],
        scene.strides[3 - axis - near],
        scene.strides[near],
        scene.samples,
        scene.origin,
    )


@scalar
def pixel_of(scene, thread):
    """The view, column and row that belong to a thread; tile by tile, so that a block's rays stay
    together.
    """
    rows, columns = scene.detector
    wide, high = scene.tile
    across, down = (columns + wide - 1) // wide, (rows + high - 1) // high
    inside, tile = thread % (wide * high), thread // (wide * high)
    view, tile = tile // (across * down), tile % (across * down)
    return view, tile % across * wide + inside % wide, tile // across * high + inside // wide


@scalar
def exists(scene, views, place):
    """Whether a place (view, column, row) is on a detector."""
    return place[0] < views and place[1] < scene.detector[1] and place[2] < scene.detector[0]


@scalar
def ray_of(scene, lines, place, method):
    """The ray of a place (view, column, row), and its pixel from the detector's centre."""
    pixel = from_centre(scene, place[1], place[2])
    line = lines[place[0]]
    axis = main_axis(line, pixel[0], pixel[1])
    return trace(line, axis, gather.near_of(axis), pixel, scene, method), pixel


@scalar
def steps_in(ray, steps, method):
    """The first step of a ray, and the one behind the last; small integers, which a GPU counts
    faster. A step is a slab, or a sample and one of its two slabs (trilinear).
    """
    if method != TRILINEAR:
        return np.int32(ray.first), np.int32(ray.last)
    first, last = trilinear.samples_in(ray, steps.samples)
    return np.int32(2 * first), np.int32(2 * last)


@scalar
def _sum3(flat, offset, index, weight):
    first, last = flat[offset + np.uint64(index[0])], flat[offset + np.uint64(index[2])]
    return weight[0] * first + weight[1] * flat[offset + np.uint64(index[1])] + weight[2] * last


@scalar
def _sum4(flat, offset, index, weight):
    low = (
        weight[0] * flat[offset + np.uint64(index[0])]
        + weight[1] * flat[offset + np.uint64(index[1])]
    )
    return (
        low
        + weight[2] * flat[offset + np.uint64(index[2])]
        + weight[3] * flat[offset + np.uint64(index[3])]
    )


@cache
def project_kernel(method, group, whole):
    """Kernel: views [n m v u] from padded volumes, one after the other in `flat`; a thread a
    ray.
    """
    corners_of, total = METHODS[method].corners, _sum3 if method == SIDDON else _sum4

    @cuda.jit
    def project(flat, lines, scene, views):
        thread = np.int64(cuda.blockIdx.x) * BLOCK + cuda.threadIdx.x
        first = cuda.blockIdx.y * group
        place = pixel_of(scene, thread)
        if not exists(scene, len(lines), place):
            return
        real = flat.dtype.type
        ray, _ = ray_of(scene, lines, place, method)
        steps = steps_of(scene, ray.axis)
        low, high = steps_in(ray, steps, method)
        totals = cuda.local.array(group, flat.dtype)
        for n in range(group):
            totals[n] = 0
        for k in range(low, high):
            index, weight = corners_of(ray, steps, k, real, whole)
            for n in range(group):
                if first + n < len(views):
                    totals[n] += total(flat, np.uint64((first + n) * scene.size), index, weight)
        for n in range(group):
            if first + n < len(views):
                views[first + n, place[0], place[2], place[1]] = real(ray.length) * totals[n]

    return project


@cache
def scatter_kernel(method, group, whole):
    """Kernel: add views [n m v u] to padded volumes, one after the other in `flat`, in no fixed
    order of addition.
    """
    corners_of, count = METHODS[method].corners, 3 if method == SIDDON else 4

    @cuda.jit
    def scatter(views, lines, scene, flat):
        thread = np.int64(cuda.blockIdx.x) * BLOCK + cuda.threadIdx.x
        first = cuda.blockIdx.y * group
        place = pixel_of(scene, thread)
        if not exists(scene, len(lines), place):
            return
        real = flat.dtype.type
        ray, _ = ray_of(scene, lines, place, method)
        steps = steps_of(scene, ray.axis)
        low, high = steps_in(ray, steps, method)
        for k in range(low, high):
            index, weight = corners_of(ray, steps, k, real, whole)
            for n in range(group):
                if first + n < len(views):
                    value = real(ray.length) * views[first + n, place[0], place[2], place[1]]
                    for i in range(count):
                        at = np.int64((first + n) * scene.size) + np.int64(index[i])
                        cuda.atomic.add(flat, at, weight[i] * value)

    return scatter


@cache
def record_kernel():
    """Kernel: what the gather needs of views first, first + 1, ..: rays [8 p], matrices, main axes
    that occur.
    """

    @cuda.jit
    def record(lines, scene, first, rays, frames, axes):
        rows, columns = scene.detector
        k = np.int64(cuda.blockIdx.x) * BLOCK + cuda.threadIdx.x
        if k >= rays.shape[1]:
            return
        view, place = k // (rows * columns), k % (rows * columns)
        line = lines[first + view]
        pixel = from_centre(scene, place % columns, place // columns)
        axes[view, gather.record(line, pixel, scene, rays, k)] = 1
        if place == 0:
            exact = cuda.local.array((3, 4), np.float64)
            projection_matrix(line, exact)
            for row in range(3):
                for column in range(4):
                    frames[view, row, column] = exact[row, column]

    return record


@cache
def gather_kernel(group):
    """Kernel: add to the box of volumes [n d h w] what some views give; a thread a voxel, always in
    the same order.
    """

    @cuda.jit
    def collect(values, rays, frames, axes, scene, first_view, volumes):
        x, y, z = scene.box[0], scene.box[1], scene.box[2]
        w, h, d = scene.box[3] - x, scene.box[4] - y, scene.box[5] - z
        voxel = np.int64(cuda.blockIdx.x) * BLOCK + cuda.threadIdx.x
        first = cuda.blockIdx.y * group
        if voxel >= np.int64(w) * h * d:
            return
        real = volumes.dtype.type
        column, row, slab = voxel % w, voxel // w % h, voxel // (np.int64(w) * h)
        place = (x + column, y + row, z + slab)
        totals = cuda.local.array(group, volumes.dtype)
        for n in range(group):
            totals[n] = 0
        pixels = np.int64(scene.detector[0]) * scene.detector[1]
        for m in range(len(frames)):
            start, begin = m * pixels, (first_view + m) * pixels
            view = gather.View(frames[m], rays, values, start, begin, scene.sizes, scene.detector)
            for axis in range(3):
                if axes[m, axis] != 0:
                    gather.collect(view, place, axis, first, totals, real)
        for n in range(group):
            if first + n < len(volumes):
                volumes[first + n, slab, row, column] += totals[n]

    return collect


@cache
def vary_kernel(method):
    """Kernel: partial sums, `change` [4 3 k m t], of the derivative of sum(views * projections) by
    the maps.

    Thread t of a view adds up every pixel t, t + threads, ..; the caller sums over threads.
    """
    slopes_of = METHODS[method].slopes

    @cuda.jit
    def vary(flat, views, lines, scene, change):
        threads, columns = change.shape[4], lines.shape[3]
        thread = np.int64(cuda.blockIdx.x) * BLOCK + cuda.threadIdx.x
        view, start = thread // threads, thread % threads
        if view >= len(lines):
            return
        own, volumes = cuda.local.array((4, 3, 3), np.float64), Values(flat, scene.size)
        own[:] = 0
        for place in range(start, scene.detector[0] * scene.detector[1], threads):
            v, u = place // scene.detector[1], place % scene.detector[1]
            ray, pixel = ray_of(scene, lines, (view, u, v), method)
            steps, p = steps_of(scene, ray.axis), (pixel[0], pixel[1], 1.0)
            for n in range(len(views) if ray.first < ray.last else 0):
                pull_back(
                    lines[view],
                    ray,
                    p,
                    scene.window,
                    views[n, view, v, u],
                    slopes_of(volumes, n, ray, steps),
                    own,
                )
        for kind in range(4):
            for axis in range(3):
                for k in range(columns):
                    change[kind, axis, k, view, start] = own[kind, axis, k]

    return vary
