"""The compiled kernels as torch operators: opaque to `torch.compile`, each one's derivative made of
the others.

Two codes of an occupancy, see `occupancy.py`. `support`: a volume is the box of a larger one
outside of which all is zero, and the operators are those of this box. `occupied`: where a volume is
not zero; only that is read, and derivatives stay dense. Second derivatives in volume and views are
made of the same operators; those in the geometry are the reference's.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mvrecon.geometry.box import placed
from mvrecon.kernels.derivatives import bent, curved, linear, transposed
from mvrecon.kernels.mapping import joined
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.occupancy import Occupancy, code_size

# numba is heavy, so the kernels are imported at their first call


@torch.library.custom_op("mvrecon::project", mutates_args=(), device_types="cpu")
def _project(
    volume: Tensor,
    lines: Tensor,
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
    support: Tensor | None = None,
    occupied: Tensor | None = None,
) -> Tensor:
    """Line integrals of volumes [n d h w] as views [n m v u]; see `reference.project`. Half volumes
    give float32.
    """
    from mvrecon.kernels.rays.cpu import operators as cpu

    part, occupancy = _read(volume, support, occupied)
    return cpu.project(part, lines, window, occupancy, detector, method)


@torch.library.custom_op("mvrecon::backproject", mutates_args=(), device_types="cpu")
def _backproject(
    views: Tensor,
    lines: Tensor,
    window: Sequence[float],
    shape: Sequence[int],
    method: str,
    support: Tensor | None = None,
) -> Tensor:
    """The exact transpose of `project`: views [n m v u] to volumes [n d h w]."""
    from mvrecon.kernels.rays.cpu import operators as cpu

    return cpu.backproject(views, lines, window, _part(shape, support), method)


@torch.library.custom_op("mvrecon::lines_vjp", mutates_args=(), device_types="cpu")
def _lines_vjp(
    volume: Tensor,
    views: Tensor,
    lines: Tensor,
    window: Sequence[float],
    method: str,
    support: Tensor | None = None,
    occupied: Tensor | None = None,
) -> Tensor:
    """The derivative of <views, project(volume, lines)> by the lines [m 4 3 3]."""
    from mvrecon.kernels.rays.cpu import operators as cpu

    part, occupancy = _read(volume, support, occupied)
    return cpu.lines_vjp(part, views, lines, window, occupancy, method)


@torch.library.custom_op("mvrecon::occupied", mutates_args=(), device_types="cpu")
def occupied(
    volume: Tensor,
    lines: Tensor,
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
    skip: str,
) -> Tensor:
    """Where volumes [n d h w] are not zero, in code, on their device; see
    `skip_policy.occupancy_of`. A GPU finds the box alone, and nobody waits for it.
    """
    from mvrecon.kernels.rays.cpu.plan import Scene
    from mvrecon.kernels.rays.cpu.skip_policy import occupancy_of

    return occupancy_of(volume, Scene(lines, window, detector, method), skip).encoded()


@occupied.register_kernel("cuda")
def _(volume, lines, window, detector, method, skip):
    from mvrecon.kernels.rays.cuda import operators as cuda

    return cuda.occupied_code(volume)


@occupied.register_fake
def _(volume, lines, window, detector, method, skip):
    return volume.new_empty(code_size(volume.shape[1:]), dtype=torch.int32)


def _read(
    volume: Tensor, support: Tensor | None, occupied: Tensor | None
) -> tuple[Tensor, Occupancy]:
    """What is to be read of volumes, and where it lies in the whole."""
    if support is not None or occupied is None:
        return volume, _part(volume.shape[1:], support)
    occupancy = Occupancy.decoded(occupied)
    return volume[:, *occupancy.box.slices], occupancy


def _part(shape: Sequence[int], support: Tensor | None) -> Occupancy:
    """Where volumes of a shape lie in the whole."""
    return Occupancy.whole(shape) if support is None else Occupancy.decoded(support)


@_project.register_kernel("cuda")
def _(volume, lines, window, detector, method, support=None, occupied=None):
    from mvrecon.kernels.rays.cuda import operators as cuda

    part = _part(volume.shape[1:], support)
    return cuda.project(volume, lines, window, part, detector, method, occupied)


@_backproject.register_kernel("cuda")
def _(views, lines, window, shape, method, support=None):
    from mvrecon.kernels.rays.cuda import operators as cuda

    return cuda.backproject(views, lines, window, _part(shape, support), method)


@_lines_vjp.register_kernel("cuda")
def _(volume, views, lines, window, method, support=None, occupied=None):
    from mvrecon.kernels.rays.cuda import operators as cuda

    part = _part(volume.shape[1:], support)
    return cuda.lines_vjp(volume, views, lines, window, part, method, occupied)


@_project.register_fake
def _(volume, lines, window, detector, method, support=None, occupied=None):
    wide = torch.float64 if volume.dtype == torch.float64 else torch.float32
    return volume.new_empty(volume.shape[0], lines.shape[0], *detector, dtype=wide)


@_backproject.register_fake
def _(views, lines, window, shape, method, support=None):
    return views.new_empty(views.shape[0], *shape)


@_lines_vjp.register_fake
def _(volume, views, lines, window, method, support=None, occupied=None):
    return lines.new_empty(lines.shape)


def _keep(ctx, inputs, output):
    first, lines, ctx.window, ctx.size, ctx.method, *codes = inputs
    ctx.support, ctx.occupied = (*codes, None, None)[:2]
    ctx.save_for_backward(first if ctx.needs_input_grad[1] else None, lines)
    ctx.shape, ctx.dtype = first.shape, first.dtype


def _project_back(ctx, views):
    volume, lines = ctx.saved_tensors
    needs_volume, needs_lines = ctx.needs_input_grad[:2]
    by_volume = by_lines = None
    if needs_volume:
        by_volume = backproject(
            views, lines, ctx.window, list(ctx.shape[1:]), ctx.method, ctx.support
        ).to(ctx.dtype)
    if needs_lines:
        by_lines = lines_vjp(
            volume, views, lines, ctx.window, ctx.method, ctx.support, ctx.occupied
        )
    return by_volume, by_lines, None, None, None, None, None


def _backproject_back(ctx, volume):
    views, lines = ctx.saved_tensors
    needs_views, needs_lines = ctx.needs_input_grad[:2]
    by_views = by_lines = None
    if needs_views:
        by_views = project(volume, lines, ctx.window, list(ctx.shape[2:]), ctx.method, ctx.support)
    if needs_lines:
        by_lines = lines_vjp(volume, views, lines, ctx.window, ctx.method, ctx.support)
    return by_views, by_lines, None, None, None, None


def _in_torch(volume, lines, window, detector, method, support=None, occupied=None):
    occupancy = None if support is None else Occupancy.unwrapped(support)

    def act(volume, lines):
        values = volume if volume.dtype == torch.float64 else volume.float()
        whole = values if occupancy is None else placed(values, occupancy.box, occupancy.shape)
        return reference.project(whole, lines, window, detector, method)

    return act


def _back_in_torch(views, lines, window, shape, method, support=None):
    return transposed(
        _in_torch(None, lines, window, views.shape[2:], method, support), (len(views), *shape)
    )


def _vjp_in_torch(volume, views, lines, window, method, support=None, occupied=None):
    return bent(_in_torch(volume, lines, window, views.shape[2:], method, support))


project = linear(_project, _in_torch, _keep, _project_back, lasting=6)
backproject = linear(_backproject, _back_in_torch, _keep, _backproject_back)
lines_vjp = curved(_lines_vjp, _vjp_in_torch)
occupied.register_vmap(joined(occupied))
