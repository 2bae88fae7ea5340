"""Cameras that move after a projector was built: followed if they require a gradient, refused
otherwise.
"""

import pickle
from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from mvrecon.operators.selection import ray_subset, view_subset
from mvrecon.testing import derivative_gap
from tests.operators.cases import DIFFERENTIABLE, Case, noise

KINDS = ("cone", "beams", "explicit")


def own(kind: str, wants: bool) -> Case:
    """A case with tensors of its own."""
    case = DIFFERENTIABLE[kind]
    return case.moved(*(vector.clone().requires_grad_(wants) for vector in case.vectors.values()))


def move(case: Case) -> None:
    """The first source by 2 mm."""
    with torch.no_grad():
        case.rays.source[0] += torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_projector_built_without_grad_follows_cameras_that_require_one(kind, backend):
    case, (x, y) = own(kind, wants=True), noise(DIFFERENTIABLE[kind])
    with torch.no_grad():
        A = case.build(backend=backend)
        subset = view_subset(A, [1])
        before = A(x)
        move(case)
        B = case.build(backend=backend)
        assert torch.equal(A(x), B(x)) and not torch.allclose(A(x), before)
        assert torch.equal(A.T(y), B.T(y))
        assert torch.equal(subset(x), view_subset(B, [1])(x))
    (change,) = torch.autograd.grad(A(x).square().sum(), case.rays.source)
    (expected,) = torch.autograd.grad(B(x).square().sum(), case.rays.source)
    assert torch.equal(change, expected) and change.norm() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_can_require_a_gradient_later(kind):
    case, x = own(kind, wants=False), noise(DIFFERENTIABLE[kind])[0]
    A = case.build()
    assert not A(x).requires_grad
    case.rays.source.requires_grad_()
    move(case)
    assert torch.equal(A(x), case.build()(x)) and A(x).requires_grad


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_modified_in_place_are_refused(kind):
    case, (x, y) = own(kind, wants=False), noise(DIFFERENTIABLE[kind])
    A = case.build()
    mask = torch.zeros(len(case.rays), *case.rays.shape, dtype=torch.bool)
    mask[0, 0, 0] = True
    subset, support = (
        ray_subset(A, mask),
        A.with_support(torch.ones(case.grid.shape, dtype=torch.bool)),
    )
    calls = [
        lambda: A(x),
        lambda: A.T(y),
        lambda: subset(x),
        lambda: support(x),
        lambda: A.with_support(None),
    ]
    for call in [*calls, lambda: deepcopy(A), lambda: pickle.dumps(A)]:
        call()
    move(case)
    for call in [*calls, lambda: deepcopy(A), lambda: pickle.dumps(A)]:
        with pytest.raises(RuntimeError, match="changed in place after the projector was built"):
            call()
    assert case.build()(x).isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_copies_of_a_projector_work_after_earlier_in_place_changes(kind):
    case, x = own(kind, wants=False), noise(DIFFERENTIABLE[kind])[0]
    move(case)
    A = case.build()
    for copied in (deepcopy(A), pickle.loads(pickle.dumps(A)), A.with_support(None)):
        assert torch.equal(copied(x), A(x))


def test_cameras_created_in_inference_mode_are_supported():
    case, x = DIFFERENTIABLE["cone"], noise(DIFFERENTIABLE["cone"])[0]
    with torch.inference_mode():
        rays = replace(case.rays, source=case.rays.source * 1)
        assert torch.equal(replace(case, rays=rays).build()(x), case.build()(x))


@pytest.mark.parametrize("kind", KINDS)
def test_a_projector_built_in_inference_mode_has_gradients(kind):
    """In volumes, views and the pose; an evaluation may have built it before a training."""
    case, (x, y) = own(kind, wants=True), noise(DIFFERENTIABLE[kind])
    fixed = own(kind, wants=False)
    with torch.inference_mode():
        operators = fixed.build(), case.build()
    for A, B in zip(operators, (fixed.build(), case.build()), strict=True):
        assert derivative_gap(A, x, y) < 1e-12
        assert torch.equal(A(x), B(x))
    (change,) = torch.autograd.grad(operators[1](x).square().sum(), case.rays.source)
    assert change.norm() > 0.1


@pytest.mark.parametrize(("name", "value"), [("method", "siddon"), ("rays_per_pixel", 2)])
def test_options_behind_the_computed_rays_cannot_be_assigned(name, value):
    """Views would be of the old rays, or a mixture: refused, as another grid or rig is."""
    A = DIFFERENTIABLE["cone"].build()
    with pytest.raises(AttributeError, match=name):
        setattr(A, name, value)
