"""The compiled CPU operators along attenuated rays. Results are identical bit for bit for any
number of threads, as in `mvrecon.kernels.rays.cpu.operators`.

A ray is traversed as a whole, since matter near the detector attenuates emission behind it: volumes
are not divided, and a thread that owns some slabs of the adjoint traverses all rays that intersect
them. Rays outside the bounding box of the emission, and the parts of other rays behind it, do not
change any bit and are skipped, unless the method has the suffix `DENSE`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.cpu.loops import scratch_of
from mvrecon.kernels.rays.cpu.operators import Copy, copies, piece_sizes
from mvrecon.kernels.rays.cpu.packed_volume import Store, add, empty, part_of, store_of
from mvrecon.kernels.rays.cpu.plan import Plan, Scene, ray_plan_of
from mvrecon.kernels.rays.cpu.skip_policy import box_of, readable
from mvrecon.kernels.rays.cpu.trace import Rig, Slabs, Space, Units, bounds_of
from mvrecon.kernels.rays.occupancy import Occupancy, boxes_of
from mvrecon.kernels.threads import parallel_for
from mvrecon_spect.kernels.distance_driven import VECTORS, Areas
from mvrecon_spect.kernels.loops import (
    TURNS,
    Emission,
    MuVolume,
    Path,
    Scratch,
    backproject_slabs,
    keep_rows,
    mu_vjp_slabs,
    project_rows,
    segments_of,
)
from mvrecon_spect.kernels.reference import DENSE, DISTANCE_DRIVEN

#: Replaces the volume of mu if there is no attenuation.
NOTHING = -1

Spread = Callable[[Store, Copy, Scratch, Slabs], None]


def transmission(mu, lines, window, detector, method):
    """Transmission from each segment to the detector, [m u v s], in the dtype of mu: column by
    column, since consecutive rays mostly differ in z.
    """
    plan, occupancy = _plan(lines, window, detector, method, mu)
    (rows, columns), segments = plan.rig.detector, segments_of(plan.rig, max(plan.rig.sizes))
    # numpy requests huge pages; with small pages, most rays would cause a page fault
    kept = np.empty((len(lines), columns, rows, segments), mu[:0].numpy().dtype)
    single = torch.zeros(len(lines), 1)
    for copy in copies(mu[None], occupancy, plan):
        reads = plan.reads[copy.store.near]

        def keep(first: int, last: int, copy=copy, reads=reads) -> None:
            scratch = _scratch(copy.rig, copy.store, single, method)
            units = Units(copy.axes, first, last)
            keep_rows(MuVolume(copy.store, 0), copy.rig, scratch, reads, kept, units)

        parallel_for(keep, plan.units, kept.size, 4)
    return torch.from_numpy(kept)


def project(volume, mu, lines, layers, window, longest, detector, method, kept=None):
    """Attenuated line integrals; see `reference.project`.

    Args:
        kept: the `transmission` of mu along the rays, in the dtype of the arithmetic.
    """
    x, shares = to_accumulation_dtype(volume), _kept(kept, volume)
    attenuates = kept is None and bool(mu.any())
    both = torch.cat([x, mu.to(x.dtype)[None]]) if attenuates else x
    plan, occupancy, space = _emitting(volume, _plan(lines, window, detector, method, mu), method)
    views = both.new_zeros(len(volume), len(lines), *plan.rig.detector, layers.shape[1]).numpy()
    for copy in copies(both, occupancy, plan) if space else ():
        emission, reads = Emission(copy.store, space), plan.reads[copy.store.near]

        def add_rows(first: int, last: int, copy=copy, emission=emission, reads=reads) -> None:
            units = Units(copy.axes, first, last)
            of_mu = MuVolume(copy.store, len(x) if attenuates else NOTHING)
            scratch = _scratch(copy.rig, copy.store, layers, method)
            project_rows(emission, of_mu, shares, copy.rig, scratch, reads, views, units)

        parallel_for(add_rows, plan.units, views.size * max(plan.rig.sizes), 4)
    return torch.from_numpy(views)


def backproject(views, mu, lines, layers, window, longest, method, kept=None):
    """The exact transpose of `project` with respect to the emission."""
    plan, occupancy = _plan(lines, window, views.shape[2:4], method, mu)
    values, shares = np.ascontiguousarray(views.numpy()), _kept(kept, views)
    at = 0 if kept is None and mu.any() else NOTHING

    def spread(into: Store, copy: Copy, scratch: Scratch, slabs: Slabs) -> None:
        reads, of_mu = plan.reads[into.near], MuVolume(copy.store, at)
        backproject_slabs(into, of_mu, shares, copy.rig, scratch, reads, values, slabs)

    made = copies(mu.to(views.dtype)[None], occupancy, plan)
    return _gathered(made, spread, len(views), views.numel(), layers, method)


def mu_vjp(volume, views, mu, lines, layers, window, longest, method, kept=None):
    """Derivative of <views, project(volume, mu)> with respect to the attenuation mu; ignores
    `kept`.
    """
    plan = _plan(lines, window, views.shape[2:4], method, mu)
    plan, occupancy, space = _emitting(volume, plan, method)
    if not space:
        return torch.zeros_like(mu)
    values = np.ascontiguousarray(views.numpy())

    def spread(into: Store, copy: Copy, scratch: Scratch, slabs: Slabs) -> None:
        reads, emission = plan.reads[into.near], Emission(copy.store, space)
        mu_vjp_slabs(into, emission, copy.rig, scratch, reads, values, slabs)

    both = torch.cat([to_accumulation_dtype(volume).to(views.dtype), mu.to(views.dtype)[None]])
    made = copies(both, occupancy, plan)
    return _gathered(made, spread, 1, views.numel(), layers, method)[0].to(mu.dtype)


def _kept(kept: Tensor | None, like: Tensor) -> np.ndarray:
    """The cached transmission as an array; empty if there is none."""
    shares = to_accumulation_dtype(like.new_empty(0, 1, 1, 1)) if kept is None else kept
    return shares.numpy()


def _scratch(rig: Rig, values: Store, layers: Tensor, method: str) -> Scratch:
    """Per-thread memory for one ray."""
    of_cells = scratch_of(rig._replace(samples=(max(rig.sizes) + VECTORS) // 2 + 1), values)
    for numbers in of_cells:
        numbers[:] = 0
    length, real = len(of_cells.one), of_cells.one.dtype
    path = Path(*np.empty((7, 3 * length), real))
    sums = np.empty(TURNS * layers.shape[1], real)
    nodes = layers.detach().double().numpy()
    areas = Areas(method.startswith(DISTANCE_DRIVEN), np.zeros((4, length), real))
    return Scratch(of_cells, path, nodes, np.empty(length, np.int32), sums, areas)


def _plan(
    lines: Tensor, window: Sequence[float], detector: Sequence[int], method: str, mu: Tensor
) -> tuple[Plan, Occupancy]:
    occupancy = Occupancy.whole(mu.shape)
    method = method.removesuffix(DENSE)
    rays = "joseph" if method == DISTANCE_DRIVEN else method
    scene = Scene(lines, window, detector, rays)
    return ray_plan_of(scene, occupancy), occupancy


def _emitting(
    volume: Float[Tensor, "n d h w"], plan: tuple[Plan, Occupancy], method: str
) -> tuple[Plan, Occupancy, Space | None]:
    """A plan and its occupancy for the rays that meet emission, and the bounding box of the
    emission; None if there is none.
    """
    whole, occupancy = plan
    emitting = occupancy
    if not method.endswith(DENSE):
        emitting = replace(occupancy, box=box_of(readable(to_accumulation_dtype(volume))))
    if not emitting.box.size:
        return whole, occupancy, None
    space = Space(whole.rig.window, whole.rig.sizes, bounds_of(emitting))
    return replace(whole, boxes=boxes_of(emitting)), occupancy, space


def _gathered(
    made: Iterator[Copy], spread: Spread, volumes: int, values: int, layers: Tensor, method: str
) -> Float[Tensor, "n d h w"]:
    """Volumes of the contributions of views in layers to slabs, by layout and axis."""
    volume, into = None, None
    for copy in made:
        x, y, z = piece_sizes(copy.rig)
        near, real = copy.store.near, copy.store.values.dtype
        if volume is None:
            volume = np.zeros((volumes, z, y, x), real)
        into = empty(volumes, (x, y, z), near, 1, real, into)
        target = store_of(into, near)
        for axis in range(3):
            if copy.axes[axis]:

                def fill(low: int, high: int, copy=copy, target=target, axis=axis) -> None:
                    axes = axis == 0, axis == 1, axis == 2
                    scratch = _scratch(copy.rig, target, layers, method)
                    spread(target, copy, scratch, Slabs(axis, axes, low, high))

                parallel_for(fill, (x, y, z)[axis], values * max(x, y, z))
        inner = part_of(into, near, (slice(0, x), slice(0, y), slice(0, z)))
        add(inner, near, volume, 0, y)
    return torch.from_numpy(volume)
