"""Derivatives: equal to finite differences and to the reference, and computed only on request."""

import pytest
import torch

from mvrecon.geometry.grid import Box
from mvrecon.kernels.rays.cpu import operators as cpu, plan
from mvrecon.testing import derivative_gap, gap, gradient_gap
from tests.operators.cases import CASES, DIFFERENTIABLE, METHODS, OPTIONS, Case, noise


def leaves(case: Case) -> list[torch.Tensor]:
    return [vector.clone().requires_grad_() for vector in case.vectors.values()]


@pytest.mark.pairwise(2, kind=DIFFERENTIABLE, option=OPTIONS)
def test_derivatives_equal_finite_differences(kind, option):
    """Also for rays that end inside the volume: at a source in it, or in front of a plane."""
    case, options = DIFFERENTIABLE[kind], OPTIONS[option]
    x, y = (each[:1] for each in noise(case))
    A = case.build(**options)
    for act, values in ((A, x), (A.T, y)):
        assert gradient_gap(act, values.clone().requires_grad_()) < 1e-6

    def both(*vectors):
        A = case.moved(*vectors).build(**options)
        return torch.cat([A(x).flatten(), A.T(y).flatten()])

    assert gradient_gap(both, *leaves(case)) < 1e-6


@pytest.mark.pairwise(kind=["cone", "beams", "explicit"], method=METHODS)
def test_second_derivatives_in_volume_and_views(kind, method):
    A = DIFFERENTIABLE[kind].build(method=method)
    x, y = noise(DIFFERENTIABLE[kind])
    assert derivative_gap(A, x, y) < 1e-12 and derivative_gap(A.T, y, x) < 1e-12


def changes(case: Case, backend: str, options: dict) -> list[torch.Tensor]:
    """Derivatives by the rays, through the views and through the adjoint."""
    x, y = noise(case, channels=2)
    vectors = leaves(case)
    A = case.moved(*vectors).build(backend=backend, **options)
    one = torch.autograd.grad((A(x) * y).sum(), vectors)
    return [*one, *torch.autograd.grad((A.T(y) * x).sum(), vectors)]


# derivatives along an axis-aligned view stand on the kinks between voxels
@pytest.mark.pairwise(1, kind=[kind for kind in CASES if kind != "axial"], option=OPTIONS)
def test_ray_derivatives_match_the_reference(kind, option, monkeypatch):
    case, options = CASES[kind], OPTIONS[option]
    expected, found = (changes(case, backend, options) for backend in ("reference", "cpu"))
    monkeypatch.setattr(plan, "BUDGET", 1)
    pieces = changes(case, "cpu", options)
    scale = max(each.norm() for each in expected)
    assert scale > 1
    for exact, each, piecewise in zip(expected, found, pieces, strict=True):
        assert (each - exact).norm() < 1e-11 * max(exact.norm(), 1e-3 * scale)
        assert (piecewise - each).norm() < 1e-12 * scale


@pytest.mark.parametrize("method", METHODS)
def test_single_precision_keeps_pose_gradients_accurate(method):
    case = CASES["cone"]
    x, y = noise(case)
    found = []
    for dtype in (torch.float64, torch.float32):
        vectors = leaves(case)
        A = case.moved(*vectors).build(method=method)
        found.append(torch.autograd.grad((A(x.to(dtype)) * y.to(dtype)).sum(), vectors))
    for exact, single in zip(*found, strict=True):
        assert single.dtype == torch.float64 and (single - exact).norm() < 1e-4 * exact.norm()


@pytest.fixture
def calls(monkeypatch):
    """Counts what the CPU does."""
    made: list[str] = []
    works = {name: getattr(cpu, name) for name in ("project", "backproject", "lines_vjp")}
    for name, work in works.items():

        def counted(*arguments, name=name, work=work):
            made.append(name)
            return work(*arguments)

        monkeypatch.setattr(cpu, name, counted)
    return made


@pytest.mark.parametrize(
    ("of_values", "of_rays", "expected"),
    [
        (True, False, ["back"]),
        (False, True, ["vjp"]),
        (True, True, ["back", "vjp"]),
        (False, False, []),
    ],
)
def test_only_requested_gradients_are_computed(of_values, of_rays, expected, calls):
    case = DIFFERENTIABLE["cone"]
    x, y = (each.requires_grad_(of_values) for each in noise(case))
    vectors = leaves(case) if of_rays else list(case.vectors.values())
    A = case.moved(*vectors).build()
    for result, forward, back in (
        (A(x), "project", "backproject"),
        (A.T(y), "backproject", "project"),
    ):
        assert result.requires_grad == bool(expected)
        calls.clear()
        if expected:
            result.sum().backward()
        assert calls == [{"back": back, "vjp": "lines_vjp"}[each] for each in expected], forward


@pytest.mark.parametrize("method", METHODS)
def test_second_pose_derivatives_match_the_reference(method):
    case = DIFFERENTIABLE["cone"]
    x, y = (each[:1] for each in noise(case))
    for act, values in (("forward", x), ("adjoint", y)):
        seconds = []
        for backend in ("cpu", "reference"):
            vectors = leaves(case)
            A = case.moved(*vectors).build(backend=backend, method=method)
            (change,) = torch.autograd.grad(
                getattr(A, act)(values).square().sum(), vectors[0], create_graph=True
            )
            seconds.append(torch.autograd.grad(change.sum(), vectors[0])[0])
        assert seconds[1].norm() > 0.1 and gap(*seconds) < 1e-10


@pytest.mark.pairwise(
    kind=["cone", "beams"],
    method=["joseph", "siddon"],
    rays=[1, 2],
    graph=[False, True],
    inner=[False, True],
)
def test_a_crop_to_some_cameras_follows_the_rig(kind, method, rays, graph, inner):
    """Built with a graph or without, its gradients are those of the whole operator in every call,
    also after the cameras moved. Also tried: each vector alone, views of the crop, its adjoint,
    supports, weights, finer grids, products, samples with operators of their own; central
    differences.
    """
    case, box = DIFFERENTIABLE[kind], Box((0, 1, 0), (3, 4, 2))
    vectors = leaves(case)
    A = case.moved(*vectors).build(method=method, rays_per_pixel=rays)
    with torch.set_grad_enabled(graph):
        crop = A.cropped(box, [1, 0])
        if inner:
            crop = crop.cropped(Box.whole(box.shape), [0, 1])
    assert crop.pose_gradient
    x, y = (each[:1] for each in noise(case))
    part = torch.zeros_like(x)
    part[..., *box.slices] = x[..., *box.slices]
    for _ in range(2):
        found, whole = crop(x[..., *box.slices]), A(part)[:, :, [1, 0]]
        assert gap(found.detach(), whole.detach()) < 1e-12
        slopes = [torch.autograd.grad((z * y).sum(), vectors) for z in (found, whole)]
        for one, other in zip(*slopes, strict=True):
            assert other.any() and gap(one, other) < 1e-10
        with torch.no_grad():
            vectors[0].add_(0.1)
