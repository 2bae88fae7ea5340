"""Tensors: memory layout and history do not change results; half precision is storage only, invalid
dtypes are rejected, geometry remains in float64.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing.measures import bits, gap, greatest
from mvrecon_bench.stresses.case import DOUBLE, EVERY, HALVES, SINGLE, DoesNotApply, case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject


def both(subject: ProjectorSubject) -> list[tuple[Callable[..., Tensor], Tensor]]:
    """The operator and its adjoint, each with an input."""
    A, x, y = subject.pair(batch=2, channels=3)
    return [(A, x), (A.T, y)]


def layouts(values: Tensor) -> Iterator[Tensor]:
    """The same values [b c ...] in other memory layouts."""
    yield values.transpose(0, 1).contiguous().transpose(0, 1)
    yield values.mT.contiguous().mT
    yield values.permute(4, 3, 2, 1, 0).contiguous().permute(4, 3, 2, 1, 0)
    yield values.contiguous(memory_format=torch.channels_last_3d)
    yield torch.stack([values.new_full((), torch.nan).expand_as(values), values], dim=-1)[..., 1]
    unaligned = torch.cat([values.new_full((1,), torch.nan), values.flatten()])
    yield unaligned[1:].view_as(values)
    yield torch.nn.functional.pad(values, (2, 1, 1, 2), value=torch.nan)[..., 1:-2, 2:-1]


@case("projector", 38, 0.0, EVERY)
def memory(subject: ProjectorSubject) -> Iterator[float]:
    """Memory of any layout: bitwise equal to contiguous memory."""
    for act, operand in both(subject):
        expected, spread = act(operand), operand[:1, :1, :, :1].expand_as(operand)
        yield sum(bits(act(other), expected) for other in layouts(operand))
        yield bits(act(spread), act(spread.contiguous()))


@case("mvrecon", 38, 0.0, DOUBLE)
def backwards(_: Subject) -> Iterator[float]:
    """Arrays with negative strides: an error, or equal to a copy."""
    points = np.arange(1.0, 7.0).reshape(2, 3) ** 2
    takes: list[tuple[Callable[[Any], Tensor], np.ndarray]] = [
        (lambda array: Grid.centred(size=(4, 3, 2), spacing=array).affine, points[1]),
        (lambda array: Grid((2, 3, 4), array).affine, np.diag([4.0, 3.0, 2.0, 1.0])[::-1]),
        (
            lambda array: ExplicitRays(array, array + 1.0).source,
            np.stack([points, points + 2.0])[:, None],
        ),
    ]
    for take, array in takes:
        try:
            yield bits(take(array[::-1]), take(array[::-1].copy()))
        except (ValueError, TypeError):
            continue


@case("projector", 39, 0.0, EVERY)
def incoming(subject: ProjectorSubject) -> Iterator[float]:
    """Gradients of any layout: bitwise equal to contiguous memory."""
    for act, operand in both(subject):
        out = act(operand.requires_grad_())
        whole = torch.rand(out.shape, dtype=torch.float64).to(out)
        spread = [out.new_ones(()).expand_as(out), whole[:1, :, :, :1].expand_as(out)]
        for gradient in [*spread, *layouts(whole)]:
            plain = gradient.clone(memory_format=torch.contiguous_format)
            slopes = (torch.autograd.grad(act(operand), operand, g)[0] for g in (gradient, plain))
            yield bits(*slopes)


@case("projector", 40)
def edited(subject: ProjectorSubject) -> Iterator[float]:
    """Edits between forward and backward: an error, or the correct gradient."""
    for act, operand in both(subject):
        expected = act(operand.requires_grad_())
        weight = torch.rand(expected.shape, dtype=torch.float64).to(expected)
        (gradient,) = torch.autograd.grad(expected, operand, weight)
        out, kept = act(operand), operand.detach().clone()
        with torch.no_grad():
            operand.fill_(torch.nan)
        yield bits(out, expected) + _unless_refused(out, operand, weight, gradient)
        with torch.no_grad():
            operand.copy_(kept)
        doubled = act(operand).mul_(2)
        yield _unless_refused(doubled, operand, weight, 2 * gradient) + bits(operand, kept)


@case("projector", 40)
def edited_pose(subject: ProjectorSubject) -> float:
    """Edits before a pose's gradient: an error, or the correct gradient."""
    views, vectors = subject.posed(GRID, subject.rig())
    volume = subject.random(1, 1, *GRID.shape)
    (expected,) = torch.autograd.grad(views(volume, *vectors).sum(), vectors[:1])
    out = views(volume, *vectors).sum()
    volume.fill_(torch.nan)
    return _unless_refused(out, vectors[0], torch.ones_like(out), expected)


def _unless_refused(out: Tensor, operand: Tensor, weight: Tensor, expected: Tensor) -> float:
    try:
        (result,) = torch.autograd.grad(out, operand, weight)
    except RuntimeError as error:
        if "inplace" not in str(error):
            raise
        return 0.0
    return bits(result, expected)


@case("projector", 41, 0.0, SINGLE)
def halves(subject: ProjectorSubject) -> Iterator[float]:
    """Half-precision volumes: bitwise equal to the same values in float32, with gradients in half
    precision.
    """
    for dtype in HALVES:
        for act, operand in both(subject):
            small = operand.to(dtype).requires_grad_()
            out, expected = act(small), act(small.detach().float())
            (slope,) = torch.autograd.grad(out.sum(), small)
            yield bits(out, expected) + (out.dtype != torch.float32)
            yield slope.dtype != dtype or not bool(slope.any())


@case("projector", 41, 1.0, SINGLE)
def rounded(subject: ProjectorSubject) -> float:
    """Rounding to half precision: at most 4e-3 in bfloat16, 5e-4 in float16."""
    return greatest(
        gap(act(operand.to(dtype)), act(operand)) / allowed
        for dtype, allowed in zip(HALVES, (4e-3, 5e-4), strict=True)
        for act, operand in both(subject)
    )


@case("projector", 41)
def no_numbers(subject: ProjectorSubject) -> Iterator[float]:
    """Integers, booleans, complex numbers, arrays: an error, or correct values of a plugin."""
    for act, operand in both(subject):
        ones = operand.round()
        real = ones.float()
        for other in (ones.int(), ones.bool(), torch.complex(real, real), ones.cpu().numpy()):
            try:
                result = act(other)
            except (ValueError, TypeError):
                continue
            ours = isinstance(getattr(act, "__self__", act), RayTransform)
            values = isinstance(other, Tensor) and not other.is_complex()
            yield ours or not values or bits(result, act(other.to(result.dtype))) > 0


@case("projector", 41)
def cast(subject: ProjectorSubject) -> Iterator[float]:
    """A module cast to half precision: geometry keeps its precision, in any dtype."""
    for dtype in EVERY:
        A, x, y = subject.pair(batch=2, channels=3)
        if not isinstance(A, torch.nn.Module):
            raise DoesNotApply("it is no torch.nn.Module")
        views, volume = A(x), A.T(y)  # type: ignore[operator]
        B: Any = A.to(dtype)
        yield bits(B(x), views) + bits(B.T(y), volume)


@case("mvrecon", 41, 0.0, DOUBLE)
def half_geometry(_: Subject) -> Iterator[float]:
    """Geometry in half precision: stored in float64 without further loss."""
    vectors = {"source": [0, 0, 9], "origin": [-1.5, 1, -7], "u": [1, 0, 0], "v": [0, -1, 0]}
    given: dict[str, Any]
    for dtype in (*HALVES, torch.float32):
        given = {name: torch.tensor([vector], dtype=dtype) for name, vector in vectors.items()}
        rig = Cameras(**given, shape=(2, 3))
        rays = ExplicitRays(given["source"][None, None], given["origin"][None, None])
        affine = torch.diag(torch.tensor([1.1, 0.7, 3.3, 1.0])).to(dtype)
        pairs = [(getattr(rig, name), given[name]) for name in VECTORS]
        pairs += [(rays.source[0, 0], given["source"]), (Grid((2, 3, 4), affine).affine, affine)]
        yield sum(a.dtype != torch.float64 or bits(a, b.double()) for a, b in pairs)


@case("projector", 42)
def autocast(subject: ProjectorSubject) -> Iterator[float]:
    """Autocast: bitwise equal, same dtypes, also of derivatives."""
    device = subject.device.partition(":")[0]
    for act, operand in both(subject):
        out = act(operand.requires_grad_())
        (gradient,) = torch.autograd.grad(out.square().sum(), operand)
        for dtype in HALVES:
            with torch.autocast(device, dtype):
                result = act(operand)
                (back,) = torch.autograd.grad(result.square().sum(), operand)
            yield (result.dtype != out.dtype) + bits(result, out) + bits(back, gradient)
