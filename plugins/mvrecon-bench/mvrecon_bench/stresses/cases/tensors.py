"""Tensors of any layout, dtype and history: what counts are the numbers that they hold."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvrecon.cameras.camera import VECTORS, Cameras
from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.projectors.ray_transform import RayTransform
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject, bits, gap, greatest

Pairs = list[tuple[Callable[[Tensor], Tensor], Tensor]]
HALVES = (torch.bfloat16, torch.float16)
EVERY = (torch.float64, torch.float32, *HALVES)


def both(subject: ProjectorSubject, batch: int = 2, channels: int = 3) -> Pairs:
    """The operator and its adjoint, each with something to act on."""
    A = subject.projector(GRID, rig := subject.rig())
    x = subject.random(batch, channels, *GRID.shape)
    return [(A, x), (A.T, subject.random(batch, channels, len(rig), *rig.shape, seed=1))]


def layouts(values: Tensor) -> Iterator[Tensor]:
    """The same values [b c . . .] in other places of memory."""
    yield values.transpose(0, 1).contiguous().transpose(0, 1)
    yield values.mT.contiguous().mT
    yield values.permute(4, 3, 2, 1, 0).contiguous().permute(4, 3, 2, 1, 0)
    yield values.contiguous(memory_format=torch.channels_last_3d)
    yield torch.stack([values.new_full((), torch.nan).expand_as(values), values], dim=-1)[..., 1]
    yield torch.cat([values.new_full((1,), torch.nan), values.flatten()])[1:].view_as(
        values
    )  # off any boundary
    yield torch.nn.functional.pad(values, (2, 1, 1, 2), value=torch.nan)[..., 1:-2, 2:-1]


def memory(subject: ProjectorSubject) -> float:
    """Turned, spread, cut out of others, and one value for many."""
    wrong = 0.0
    for act, given in both(subject):
        expected = act(given)
        wrong += sum(bits(act(other), expected) for other in layouts(given))
        spread = given[:1, :1, :, :1].expand_as(given)
        wrong += bits(act(spread), act(spread.contiguous()))
    return wrong


def backwards(subject: Subject) -> float:
    """Arrays of numpy that run backwards: refused, or read as their copy."""
    points = np.arange(1.0, 7.0).reshape(2, 3) ** 2
    takes: list[tuple[Callable[[Any], Tensor], np.ndarray]] = [
        (lambda array: Grid.centred(size=(4, 3, 2), spacing=array).affine, points[1]),
        (lambda array: Grid((2, 3, 4), array).affine, np.diag([4.0, 3.0, 2.0, 1.0])[::-1]),
        (
            lambda array: ExplicitRays(array, array + 1.0).source,
            np.stack([points, points + 2.0])[:, None],
        ),
    ]
    wrong = 0.0
    for take, array in takes:
        try:
            wrong += bits(take(array[::-1]), take(array[::-1].copy()))
        except (ValueError, TypeError):
            continue
    return wrong


def incoming(subject: ProjectorSubject) -> float:
    """The gradient that comes back is expanded, as that of a sum is, turned, or cut out."""
    wrong = 0.0
    for act, given in both(subject):
        out = act(given.requires_grad_())
        whole = torch.rand(out.shape, dtype=torch.float64).to(out)
        spread = [out.new_ones(()).expand_as(out), whole[:1, :, :, :1].expand_as(out)]
        for gradient in [*spread, *layouts(whole)]:
            plain = gradient.clone(memory_format=torch.contiguous_format)
            found, expected = (
                torch.autograd.grad(act(given), given, each)[0] for each in (gradient, plain)
            )
            wrong += bits(found, expected)
    return wrong


def edited(subject: ProjectorSubject) -> float:
    """What went in, and what came out, is written over before the derivative is asked for."""
    wrong = 0.0
    for act, given in both(subject):
        expected = act(given.requires_grad_())
        weight = torch.rand(expected.shape, dtype=torch.float64).to(expected)
        (gradient,) = torch.autograd.grad(expected, given, weight)
        out, kept = act(given), given.detach().clone()
        with torch.no_grad():
            given.fill_(torch.nan)
        wrong += bits(out, expected) + _unless_refused(out, given, weight, gradient)
        with torch.no_grad():
            given.copy_(kept)
        doubled = act(given).mul_(2)
        wrong += _unless_refused(doubled, given, weight, 2 * gradient) + bits(given, kept)
    return wrong


def edited_pose(subject: ProjectorSubject) -> float:
    """The volume is written over before the derivative by the cameras is asked for, which needs
    it.
    """
    views, vectors = subject.posed(GRID, subject.rig())
    volume = subject.random(1, 1, *GRID.shape)
    (expected,) = torch.autograd.grad(views(volume, *vectors).sum(), vectors[:1])
    out = views(volume, *vectors).sum()
    volume.fill_(torch.nan)
    return _unless_refused(out, vectors[0], torch.ones_like(out), expected)


def _unless_refused(out: Tensor, given: Tensor, weight: Tensor, expected: Tensor) -> float:
    try:
        (found,) = torch.autograd.grad(out, given, weight)
    except RuntimeError as error:
        if "inplace" not in str(error):
            raise
        return 0.0
    return bits(found, expected)


def halves(subject: ProjectorSubject) -> float:
    """Halves are storage: read as they are, summed and given back in float32; gradients in the
    input's dtype.
    """
    wrong = 0.0
    for dtype in HALVES:
        for act, given in both(subject):
            small = given.to(dtype).requires_grad_()
            out, expected = act(small), act(small.detach().float())
            out.sum().backward()
            wrong += bits(out, expected) + (out.dtype != torch.float32)
            wrong += small.grad is None or small.grad.dtype != dtype or not bool(small.grad.any())
    return wrong


def rounded(subject: ProjectorSubject) -> float:
    """By how much more than a half's own rounding the views of half volumes are off."""
    errors = []
    for dtype, allowed in ((torch.bfloat16, 4e-3), (torch.float16, 5e-4)):
        errors += [gap(act(given.to(dtype)), act(given)) / allowed for act, given in both(subject)]
    return greatest(errors)


def no_numbers(subject: ProjectorSubject) -> float:
    """Integers, masks, complex numbers, arrays: refused; a plugin may read them, if rightly."""
    wrong = 0.0
    for act, given in both(subject):
        ones = given.round()
        for other in (
            ones.int(),
            ones.bool(),
            torch.complex(ones.float(), ones.float()),
            ones.cpu().numpy(),
        ):
            try:
                found = act(other)  # type: ignore[arg-type]
            except (ValueError, TypeError):
                continue
            numbers = (
                other.to(found.dtype)
                if isinstance(other, Tensor) and not other.is_complex()
                else None
            )
            ours = isinstance(getattr(act, "__self__", act), RayTransform)
            wrong += ours or numbers is None or bits(found, act(numbers)) > 0
    return wrong


def cast(subject: ProjectorSubject) -> float:
    """The whole module cast to another dtype, as a trainer does: geometry stays as exact as it
    was.
    """
    wrong = 0.0
    for dtype in EVERY:
        (A, x), (_, y) = both(subject)
        if not isinstance(A, torch.nn.Module):
            raise DoesNotApply("it is no torch.nn.Module")
        views, volume = A(x), A.T(y)  # type: ignore[operator]
        B = A.to(dtype)
        wrong += bits(B(x), views) + bits(B.T(y), volume)  # type: ignore[operator]
    return wrong


def half_geometry(subject: Subject) -> float:
    """Cameras, grids and rays given in half or single precision: held in float64, as exact as what
    was given.
    """
    wrong = 0.0
    vectors = {"source": [0, 0, 9], "origin": [-1.5, 1, -7], "u": [1, 0, 0], "v": [0, -1, 0]}
    for dtype in (*HALVES, torch.float32):
        given = {name: torch.tensor([each], dtype=dtype) for name, each in vectors.items()}
        source, origin, u, v = given.values()
        rig, rays = (
            Cameras(source, origin, u, v, (2, 3)),
            ExplicitRays(source[None, None], origin[None, None]),
        )
        affine = torch.diag(torch.tensor([1.1, 0.7, 3.3, 1.0])).to(dtype)
        pairs = [(getattr(rig, name), given[name]) for name in VECTORS]
        pairs += [(rays.source[0, 0], given["source"]), (Grid((2, 3, 4), affine).affine, affine)]
        wrong += sum(
            held.dtype != torch.float64 or bits(held, each.double()) for held, each in pairs
        )
    return wrong


def autocast(subject: ProjectorSubject) -> float:
    """Inside an autocast, derivatives included."""
    wrong, device = 0.0, subject.device.partition(":")[0]
    for act, given in both(subject):
        out = act(given.requires_grad_())
        (gradient,) = torch.autograd.grad(out.square().sum(), given)
        for dtype in HALVES:
            with torch.autocast(device, dtype):
                found = act(given)
                (back,) = torch.autograd.grad(found.square().sum(), given)
            wrong += (found.dtype != out.dtype) + bits(found, out) + bits(back, gradient)
    return wrong


CASES = (
    Case(
        38,
        "memory of any layout",
        "the same bits as contiguous memory",
        "projector",
        memory,
        dtypes=EVERY,
    ),
    Case(
        38,
        "arrays that run backwards",
        "refused, or read as their copy",
        "mvrecon",
        backwards,
        dtypes=EVERY[:1],
    ),
    Case(
        39,
        "gradients of any layout",
        "the same bits as contiguous memory",
        "projector",
        incoming,
        dtypes=EVERY,
    ),
    Case(
        40,
        "edits between forward and backward",
        "refused, or the right gradient",
        "projector",
        edited,
    ),
    Case(
        40,
        "edits before a pose's gradient",
        "refused, or the right gradient",
        "projector",
        edited_pose,
    ),
    Case(
        41,
        "half volumes",
        "the bits of the same values in float32",
        "projector",
        halves,
        dtypes=EVERY[1:2],
    ),
    Case(
        41,
        "rounding to halves",
        "off by 4e-3 in bf16 and 5e-4 in fp16 at most",
        "projector",
        rounded,
        1.0,
        EVERY[1:2],
    ),
    Case(
        41,
        "what holds no numbers",
        "refused; a plugin may read integers rightly",
        "projector",
        no_numbers,
    ),
    Case(41, "a module cast to a half", "its geometry is as exact as before", "projector", cast),
    Case(
        41,
        "geometry in halves",
        "held in float64, as exact as given",
        "mvrecon",
        half_geometry,
        dtypes=EVERY[:1],
    ),
    Case(42, "autocast", "the same bits and dtypes as without", "projector", autocast),
)
