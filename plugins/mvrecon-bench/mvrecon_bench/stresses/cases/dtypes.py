"""Dtypes: half precision is storage only, invalid dtypes are rejected, geometry remains in
float64.
"""

import torch
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras, ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing.measures import bits, gap, greatest
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.cases.tensors import EVERY, HALVES, both
from mvrecon_bench.stresses.subject import ProjectorSubject, Subject


def halves(subject: ProjectorSubject) -> float:
    """Half precision is storage only: sums and results are float32, gradients have the input's
    dtype.
    """
    violations = 0.0
    for dtype in HALVES:
        for act, operand in both(subject):
            small = operand.to(dtype).requires_grad_()
            out, expected = act(small), act(small.detach().float())
            out.sum().backward()
            violations += bits(out, expected) + (out.dtype != torch.float32)
            violations += (
                small.grad is None or small.grad.dtype != dtype or not bool(small.grad.any())
            )
    return violations


def rounded(subject: ProjectorSubject) -> float:
    """Error of views of half-precision volumes, which must not exceed the rounding of half
    precision.
    """
    errors = []
    for dtype, allowed in ((torch.bfloat16, 4e-3), (torch.float16, 5e-4)):
        errors += [
            gap(act(operand.to(dtype)), act(operand)) / allowed for act, operand in both(subject)
        ]
    return greatest(errors)


def no_numbers(subject: ProjectorSubject) -> float:
    """Integers, masks, complex numbers and arrays are rejected; a plugin may also process them
    correctly.
    """
    violations = 0.0
    for act, operand in both(subject):
        ones = operand.round()
        for other in (
            ones.int(),
            ones.bool(),
            torch.complex(ones.float(), ones.float()),
            ones.cpu().numpy(),
        ):
            try:
                result = act(other)  # type: ignore[arg-type]
            except (ValueError, TypeError):
                continue
            numbers = (
                other.to(result.dtype)
                if isinstance(other, Tensor) and not other.is_complex()
                else None
            )
            ours = isinstance(getattr(act, "__self__", act), RayTransform)
            violations += ours or numbers is None or bits(result, act(numbers)) > 0
    return violations


def cast(subject: ProjectorSubject) -> float:
    """Casting the module to another dtype, as a trainer does, preserves the precision of the
    geometry.
    """
    violations = 0.0
    for dtype in EVERY:
        (A, x), (_, y) = both(subject)
        if not isinstance(A, torch.nn.Module):
            raise DoesNotApply("it is no torch.nn.Module")
        views, volume = A(x), A.T(y)  # type: ignore[operator]
        B = A.to(dtype)
        violations += bits(B(x), views) + bits(B.T(y), volume)  # type: ignore[operator]
    return violations


def half_geometry(subject: Subject) -> float:
    """Cameras, grids and rays from half or single precision are stored in float64 without further
    loss.
    """
    violations = 0.0
    vectors = {"source": [0, 0, 9], "origin": [-1.5, 1, -7], "u": [1, 0, 0], "v": [0, -1, 0]}
    for dtype in (*HALVES, torch.float32):
        rounded_vectors = {
            name: torch.tensor([vector], dtype=dtype) for name, vector in vectors.items()
        }
        source, origin, u, v = rounded_vectors.values()
        rig, rays = (
            Cameras(source, origin, u, v, (2, 3)),
            ExplicitRays(source[None, None], origin[None, None]),
        )
        affine = torch.diag(torch.tensor([1.1, 0.7, 3.3, 1.0])).to(dtype)
        pairs = [(getattr(rig, name), rounded_vectors[name]) for name in VECTORS]
        pairs += [
            (rays.source[0, 0], rounded_vectors["source"]),
            (Grid((2, 3, 4), affine).affine, affine),
        ]
        violations += sum(
            stored.dtype != torch.float64 or bits(stored, vector.double())
            for stored, vector in pairs
        )
    return violations


def autocast(subject: ProjectorSubject) -> float:
    """Forward and derivatives under autocast."""
    violations, device = 0.0, subject.device.partition(":")[0]
    for act, operand in both(subject):
        out = act(operand.requires_grad_())
        (gradient,) = torch.autograd.grad(out.square().sum(), operand)
        for dtype in HALVES:
            with torch.autocast(device, dtype):
                result = act(operand)
                (back,) = torch.autograd.grad(result.square().sum(), operand)
            violations += (result.dtype != out.dtype) + bits(result, out) + bits(back, gradient)
    return violations


CASES = (
    Case(
        41,
        "half-precision volumes",
        "bitwise equal to the same values in float32",
        "projector",
        halves,
        dtypes=EVERY[1:2],
    ),
    Case(
        41,
        "rounding to half precision",
        "at most 4e-3 in bfloat16, 5e-4 in float16",
        "projector",
        rounded,
        1.0,
        EVERY[1:2],
    ),
    Case(
        41,
        "integers and booleans",
        "an error, or correct values",
        "projector",
        no_numbers,
    ),
    Case(41, "a module cast to half precision", "geometry keeps its precision", "projector", cast),
    Case(
        41,
        "geometry in half precision",
        "stored in float64 without further loss",
        "mvrecon",
        half_geometry,
        dtypes=EVERY[:1],
    ),
    Case(42, "autocast", "bitwise equal, same dtypes", "projector", autocast),
)
