"""Memory layout and history of tensors: results depend only on values."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.testing.measures import bits
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject

Pairs = list[tuple[Callable[[Tensor], Tensor], Tensor]]
HALVES = (torch.bfloat16, torch.float16)
EVERY = (torch.float64, torch.float32, *HALVES)


def both(subject: ProjectorSubject, batch: int = 2, channels: int = 3) -> Pairs:
    """The operator and its adjoint, each with an input."""
    A = subject.projector(GRID, rig := subject.rig())
    x = subject.random(batch, channels, *GRID.shape)
    return [(A, x), (A.T, subject.random(batch, channels, len(rig), *rig.shape, seed=1))]


def layouts(values: Tensor) -> Iterator[Tensor]:
    """The same values [b c ...] in other memory layouts."""
    yield values.transpose(0, 1).contiguous().transpose(0, 1)
    yield values.mT.contiguous().mT
    yield values.permute(4, 3, 2, 1, 0).contiguous().permute(4, 3, 2, 1, 0)
    yield values.contiguous(memory_format=torch.channels_last_3d)
    yield torch.stack([values.new_full((), torch.nan).expand_as(values), values], dim=-1)[..., 1]
    yield torch.cat([values.new_full((1,), torch.nan), values.flatten()])[1:].view_as(
        values
    )  # unaligned
    yield torch.nn.functional.pad(values, (2, 1, 1, 2), value=torch.nan)[..., 1:-2, 2:-1]


def memory(subject: ProjectorSubject) -> float:
    """Transposed, strided, sliced and expanded tensors."""
    violations = 0.0
    for act, operand in both(subject):
        expected = act(operand)
        violations += sum(bits(act(other), expected) for other in layouts(operand))
        spread = operand[:1, :1, :, :1].expand_as(operand)
        violations += bits(act(spread), act(spread.contiguous()))
    return violations


def backwards(subject: Subject) -> float:
    """NumPy arrays with negative strides: rejected, or treated as a copy."""
    points = np.arange(1.0, 7.0).reshape(2, 3) ** 2
    takes: list[tuple[Callable[[Any], Tensor], np.ndarray]] = [
        (lambda array: Grid.centred(size=(4, 3, 2), spacing=array).affine, points[1]),
        (lambda array: Grid((2, 3, 4), array).affine, np.diag([4.0, 3.0, 2.0, 1.0])[::-1]),
        (
            lambda array: ExplicitRays(array, array + 1.0).source,
            np.stack([points, points + 2.0])[:, None],
        ),
    ]
    violations = 0.0
    for take, array in takes:
        try:
            violations += bits(take(array[::-1]), take(array[::-1].copy()))
        except (ValueError, TypeError):
            continue
    return violations


def incoming(subject: ProjectorSubject) -> float:
    """Incoming gradients that are expanded (as for a sum), transposed or sliced."""
    violations = 0.0
    for act, operand in both(subject):
        out = act(operand.requires_grad_())
        whole = torch.rand(out.shape, dtype=torch.float64).to(out)
        spread = [out.new_ones(()).expand_as(out), whole[:1, :, :, :1].expand_as(out)]
        for gradient in [*spread, *layouts(whole)]:
            plain = gradient.clone(memory_format=torch.contiguous_format)
            result, expected = (
                torch.autograd.grad(act(operand), operand, cotangent)[0]
                for cotangent in (gradient, plain)
            )
            violations += bits(result, expected)
    return violations


def edited(subject: ProjectorSubject) -> float:
    """Input and output are modified in place before the backward pass."""
    violations = 0.0
    for act, operand in both(subject):
        expected = act(operand.requires_grad_())
        weight = torch.rand(expected.shape, dtype=torch.float64).to(expected)
        (gradient,) = torch.autograd.grad(expected, operand, weight)
        out, kept = act(operand), operand.detach().clone()
        with torch.no_grad():
            operand.fill_(torch.nan)
        violations += bits(out, expected) + _unless_refused(out, operand, weight, gradient)
        with torch.no_grad():
            operand.copy_(kept)
        doubled = act(operand).mul_(2)
        violations += _unless_refused(doubled, operand, weight, 2 * gradient) + bits(operand, kept)
    return violations


def edited_pose(subject: ProjectorSubject) -> float:
    """The volume is modified in place before the backward pass of the cameras, which requires
    it.
    """
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


CASES = (
    Case(
        38,
        "memory of any layout",
        "bitwise equal to contiguous memory",
        "projector",
        memory,
        dtypes=EVERY,
    ),
    Case(
        38,
        "arrays with negative strides",
        "an error, or equal to a copy",
        "mvrecon",
        backwards,
        dtypes=EVERY[:1],
    ),
    Case(
        39,
        "gradients of any layout",
        "bitwise equal to contiguous memory",
        "projector",
        incoming,
        dtypes=EVERY,
    ),
    Case(
        40,
        "edits between forward and backward",
        "an error, or the correct gradient",
        "projector",
        edited,
    ),
    Case(
        40,
        "edits before a pose's gradient",
        "an error, or the correct gradient",
        "projector",
        edited_pose,
    ),
)
