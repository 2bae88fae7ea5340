"""The compiled operators of the CPU along attenuated rays; every result is the same to the last bit
for any number of threads, as those of `operators.py`.

A ray is read as a whole, since what lies near the detector weakens what lies behind it: volumes are
one piece, and a thread that owns some slabs of the adjoint walks all of the rays that meet them.
Rays beside the box of the emission, and what lies behind it on the others, change no bit and are
left out, but for a method with the suffix `DENSE`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays.cpu.attenuated_loops import (
    Desk,
    Emission,
    Matter,
    backproject_slabs,
    bend_slabs,
    path_of,
    project_rows,
)
from mvrecon.kernels.rays.cpu.loops import room_of
from mvrecon.kernels.rays.cpu.operators import Copy, copies, piece_sizes
from mvrecon.kernels.rays.cpu.packed_volume import Store, add, empty, part_of, store
from mvrecon.kernels.rays.cpu.plan import Plan, Scene, whole_plan_of
from mvrecon.kernels.rays.cpu.rig import Rig, Slabs, Units, bounds_of
from mvrecon.kernels.rays.cpu.skip_policy import box_of, readable
from mvrecon.kernels.rays.occupancy import DENSE, Occupancy, boxes_of
from mvrecon.kernels.rays.trace import Space
from mvrecon.kernels.threads import parallel_for

Spread = Callable[[Store, Copy, Desk, Slabs], None]


class Spreading(NamedTuple):
    """What an adjoint spreads into: how many volumes, for how many values of views in layers."""

    volumes: int
    values: int
    layers: Tensor


def _desk(rig: Rig, values: Store, layers: Tensor) -> Desk:
    room = room_of(rig, values)
    return Desk(room, path_of(room), layers.detach().double().numpy())


def project(volume, mu, lines, layers, window, detector, method):
    """Attenuated line integrals; see `attenuated_reference.project`."""
    both = torch.cat([wide(volume), mu.to(wide(volume[:0]).dtype)[None]])
    plan, occupancy = _plan(lines, window, detector, method, mu)
    emitting = occupancy if method.endswith(DENSE) else _emitting(volume)
    plan = replace(plan, boxes=boxes_of(emitting))
    space = Space(plan.rig.window, plan.rig.sizes, bounds_of(emitting))
    views = np.zeros(
        (len(volume), len(lines), *plan.rig.detector, layers.shape[1]), both.numpy().dtype
    )
    if not emitting.box.size:
        return torch.from_numpy(views)
    for copy in copies(both, occupancy, plan):
        matter, reads = Matter(copy.store, len(volume)), plan.reads[copy.store.near]
        emission = Emission(copy.store, space)

        def add_rows(
            first: int, last: int, copy=copy, emission=emission, matter=matter, reads=reads
        ) -> None:
            units, desk = Units(copy.axes, first, last), _desk(copy.rig, copy.store, layers)
            project_rows(emission, matter, copy.rig, desk, reads, views, units)

        parallel_for(add_rows, plan.units, views.size * max(plan.rig.sizes), 4)
    return torch.from_numpy(views)


def backproject(views, mu, lines, layers, window, method):
    """The exact transpose of `project` in the emission."""
    plan, occupancy = _plan(lines, window, views.shape[2:4], method, mu)
    values = np.ascontiguousarray(views.numpy())

    def spread(into: Store, copy: Copy, desk: Desk, slabs: Slabs) -> None:
        reads = plan.reads[into.near]
        backproject_slabs(into, Matter(copy.store, 0), copy.rig, desk, reads, values, slabs)

    made = copies(mu.to(views.dtype)[None], occupancy, plan)
    return _gathered(made, spread, Spreading(len(views), views.numel(), layers))


def mu_vjp(volume, views, mu, lines, layers, window, method):
    """The derivative of <views, project(volume, mu)> by the attenuation mu."""
    plan, occupancy = _plan(lines, window, views.shape[2:4], method, mu)
    emitting = occupancy if method.endswith(DENSE) else _emitting(volume)
    if not emitting.box.size:
        return torch.zeros_like(mu)
    plan = replace(plan, boxes=boxes_of(emitting))
    space = Space(plan.rig.window, plan.rig.sizes, bounds_of(emitting))
    values = np.ascontiguousarray(views.numpy())

    def spread(into: Store, copy: Copy, desk: Desk, slabs: Slabs) -> None:
        reads, emission = plan.reads[into.near], Emission(copy.store, space)
        bend_slabs(into, emission, copy.rig, desk, reads, values, slabs)

    both = torch.cat([wide(volume).to(views.dtype), mu.to(views.dtype)[None]])
    made = copies(both, occupancy, plan)
    return _gathered(made, spread, Spreading(1, views.numel(), layers))[0].to(mu.dtype)


def _emitting(volume: Float[Tensor, "n d h w"]) -> Occupancy:
    return replace(Occupancy.whole(volume.shape[1:]), box=box_of(readable(wide(volume))))


def _plan(
    lines: Tensor, window: Sequence[float], detector: Sequence[int], method: str, mu: Tensor
) -> tuple[Plan, Occupancy]:
    scene = Scene(lines, window, detector, method.removesuffix(DENSE))
    occupancy = Occupancy.whole(mu.shape)
    return whole_plan_of(scene, occupancy), occupancy


def _gathered(
    made: Iterator[Copy], spread: Spread, spreading: Spreading
) -> Float[Tensor, "n d h w"]:
    """What is spread into slabs, layout by layout and axis by axis, as volumes."""
    volume, into = None, None
    for copy in made:
        x, y, z = piece_sizes(copy.rig)
        near, real = copy.store.near, copy.store.values.dtype
        if volume is None:
            volume = np.zeros((spreading.volumes, z, y, x), real)
        into = empty(spreading.volumes, (x, y, z), near, 1, real, into)
        target = store(into, near)
        for axis in range(3):
            if copy.axes[axis]:

                def fill(low: int, high: int, copy=copy, target=target, axis=axis) -> None:
                    spread(
                        target,
                        copy,
                        _desk(copy.rig, target, spreading.layers),
                        Slabs(axis, low, high),
                    )

                parallel_for(fill, (x, y, z)[axis], spreading.values * max(x, y, z))
        inner = part_of(into, near, (slice(0, x), slice(0, y), slice(0, z)))
        add(inner, near, volume, 0, y)
    return torch.from_numpy(volume)
