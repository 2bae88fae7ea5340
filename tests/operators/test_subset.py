"""Some of the rays: the entries of the whole, adjoint to them, and cheaper."""

import pytest
import torch

from mvrecon.kernels.rays.cpu import operators as cpu
from mvrecon.operators.drr import Drr
from mvrecon.operators.selection import (
    RaySelection,
    ViewSelection,
    ordered_subsets,
    ray_subset,
    view_subset,
)
from mvrecon.testing import adjoint_gap, gap, gradient_gap, subset_gap
from tests.operators.cases import CASES, DIFFERENTIABLE, OPTIONS, Case, noise

#: Of each way through the loops: upright columns inside and beside the volume, pinholes, beams,
#: rays one by one.
KINDS = ["cone", "cone beyond", "stack", "dome", "dcspect80", "tilted beams", "inside", "explicit"]
#: A projector's options: a ray a pixel, or the mean over several.
RAYS = [(kind, 1) for kind in KINDS] + [("cone", 2), ("dome", 2), ("tilted beams", 3)]


def some(case: Case, share: float = 0.4) -> torch.Tensor:
    """A mask of pixels, of none of the first view's."""
    rng = torch.Generator().manual_seed(1)
    chosen = torch.rand(len(case.rays), *case.rays.shape, generator=rng) < share
    chosen[0] = False
    return chosen


def leaves(case: Case) -> list[torch.Tensor]:
    return [vector.clone().requires_grad_() for vector in case.vectors.values()]


@pytest.mark.pairwise(case=RAYS, option=OPTIONS, dtype=[torch.float32, torch.float64])
def test_subsets_are_entries_of_the_full_operator(case, option, dtype):
    """And of its adjoint, which makes them adjoint to one another."""
    case, rays = CASES[case[0]], case[1]
    A, chosen = case.build(rays_per_pixel=rays, **OPTIONS[option]), some(case)
    x, y = noise(case, dtype, channels=2)
    # upright columns are read in another order; in float32 a crossing under a small slope is known
    # to fewer digits
    views, tolerance = A(x), 1e-12 if dtype == torch.float64 else 5e-6 if case.upright else 1e-6
    order = [len(case.rays) - 1, 0]
    for S, entries in (
        (RaySelection(A.range_shape, chosen), views[:, :, chosen]),
        (ViewSelection(A.range_shape, order), views[:, :, order]),
    ):
        assert A.subset(S)(x).dtype == dtype and torch.equal(S(views), entries)
        assert torch.equal(S.T(S(y)), torch.where(S.T(torch.ones_like(S(y))) != 0, y, 0))
        assert subset_gap(A, S, x, y) < tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_complementary_subsets_sum_to_the_full_operator(kind):
    case = CASES[kind]
    A, chosen = case.build(), some(case)
    _, y = noise(case)
    halves = [ray_subset(A, chosen), ray_subset(A, ~chosen)]
    dealt = [
        [view_subset(A, views) for views in ordered_subsets(len(case.rays), n)]
        for n in (2, len(case.rays))
    ]
    for parts in (halves, *dealt):
        assert gap(torch.stack([B.T(B.selection(y)) for B in parts]).sum(dim=0), A.T(y)) < 1e-12
    assert [list(views) for views in ordered_subsets(5, 2)] == [[0, 2, 4], [1, 3]]


@pytest.mark.parametrize(
    ("kind", "method", "rays"),
    [
        ("cone", "siddon", 2),
        ("dome", "trilinear", 1),
        ("beams", "joseph", 2),
        ("explicit", "joseph", 1),
    ],
)
def test_derivatives_equal_finite_differences(kind, method, rays):
    case = DIFFERENTIABLE[kind]
    x, vectors = noise(case)[0][:1].requires_grad_(), leaves(case)

    def subset(*vectors):
        return ray_subset(
            case.moved(*vectors).build(method=method, rays_per_pixel=rays), some(case)
        )

    values = subset(*vectors).selection(noise(case)[1][:1]).requires_grad_()
    assert gradient_gap(lambda x, *v: subset(*v)(x), x, *vectors) < 1e-6
    assert gradient_gap(lambda y, *v: subset(*v).T(y), values, *vectors) < 1e-6


@pytest.mark.pairwise(1, case=RAYS, option=OPTIONS)
def test_derivatives_match_the_full_operator(case, option):
    case, rays = CASES[case[0]], case[1]
    x, y = noise(case)
    vectors = leaves(case)
    A = case.moved(*vectors).build(rays_per_pixel=rays, **OPTIONS[option])
    for B in (ray_subset(A, some(case)), view_subset(A, [2, 0] if len(case.rays) > 2 else [1])):
        values, volume = B.selection(y).requires_grad_(), x.clone().requires_grad_()
        leaf = [volume, values, *vectors]
        found = torch.autograd.grad(
            (B(volume) * values).sum() + (B.T(values) * volume.square()).sum(), leaf
        )
        whole = B.selection.T(values)
        expected = torch.autograd.grad(
            (A(volume) * whole).sum() + (A.T(whole) * volume.square()).sum(), leaf
        )
        for one, other in zip(found, expected, strict=True):
            assert gap(one, other) < 1e-11


def test_the_reference_agrees():
    for kind in ("cone", "dome", "explicit"):
        case = CASES[kind]
        x, y = noise(case)
        one, other = (
            ray_subset(case.build(backend=backend), some(case)) for backend in ("cpu", "reference")
        )
        assert (
            gap(one(x), other(x)) < 1e-12
            and gap(one.T(one.selection(y)), other.T(other.selection(y))) < 1e-12
        )


@pytest.mark.parametrize("kind", ["cone", "dome", "explicit"])
def test_subsets_use_the_support_and_skipping_of_the_projector(kind):
    case = CASES[kind]
    x, y = noise(case)
    support = torch.zeros(case.grid.shape, dtype=torch.bool)
    support[1:4, 2:5, 3:6] = True
    A = case.build(support=support)
    for B in (ray_subset(A, some(case)), view_subset(A, [1])):
        assert (
            gap(B(x), B.selection(A(x))) < 1e-12
            and gap(B(x), B(x * support)) < 1e-12
            and B(x).any()
        )
        volume = B.T(B.selection(y))
        assert volume.any() and not volume[..., ~support].any()
    full, *less = (
        ray_subset(case.build(skip=skip), some(case)) for skip in ("off", "box", "brick", "verify")
    )
    for B in less:
        assert torch.equal(B(x * support), full(x * support))


def test_an_empty_subset_of_rays_is_supported():
    for kind in ("cone", "explicit"):
        for backend in ("cpu", "reference"):
            A = CASES[kind].build(backend=backend)
            x, _ = noise(CASES[kind])
            for B in (ray_subset(A, some(CASES[kind], -1.0)), view_subset(A, [])):
                assert B(x).numel() == 0 and B(x).shape[:2] == x.shape[:2]
                assert not B.T(B(x)).any() and B.T(B(x)).shape == x.shape


def test_a_custom_projector_is_computed_as_a_whole():
    class Halved(Drr):
        def forward(self, volume):
            return super().forward(volume) / 2

        def adjoint(self, views):
            return super().adjoint(views / 2)

    case = CASES["dome"]
    A, (x, y) = Halved(case.grid, case.rays), noise(case)
    shape = A.range_shape
    for S in (RaySelection(shape, some(case)), ViewSelection(shape, [2, 1])):
        B = A.subset(S)
        assert not A.capabilities and torch.equal(B(x), S(A(x)))
        assert adjoint_gap(B, x, S(y)) < 1e-12


def test_only_the_rays_of_the_subset_are_computed(monkeypatch):
    case, computed = CASES["dome"], []
    project, backproject = cpu.project, cpu.backproject

    def forward(*given):
        views = project(*given)
        computed.append(views[0].numel())
        return views

    def back(views, *rest):
        computed.append(views[0].numel())
        return backproject(views, *rest)

    monkeypatch.setattr(cpu, "project", forward)
    monkeypatch.setattr(cpu, "backproject", back)
    x, y = noise(case)
    for rays in (1, 2):
        A, chosen = case.build(rays_per_pixel=rays), some(case)
        for B, count in (
            (ray_subset(A, chosen), int(chosen.sum())),
            (view_subset(A, [3]), chosen[3].numel()),
        ):
            computed.clear()
            B(x), B.T(B.selection(y))
            assert computed == [count * rays**2] * 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda A: ray_subset(A, torch.ones(4, 5, 8)),
            r"mask \[m v u\] of sizes \(4, 8, 5\), got torch.float32",
        ),
        (
            lambda A: ray_subset(A, torch.ones(4, 5, 8, dtype=torch.bool)),
            r"\(4, 8, 5\), got torch.bool \(4, 5, 8\)",
        ),
        (lambda A: view_subset(A, [0, 4]), r"different views from 0 to 3, got \[0, 4\]"),
        (lambda A: view_subset(A, [-1]), r"from 0 to 3, got \[-1\]"),
        (lambda A: view_subset(A, [1, 1]), r"different views .* got \[1, 1\]"),
        (lambda A: ordered_subsets(4, 0), "1 to 4 subsets .* got 0"),
        (lambda A: ordered_subsets(4, 5), "1 to 4 subsets .* got 5"),
        (lambda A: view_subset(A, [1])(torch.zeros(1, 1, 7, 6, 5)), r"volume .*\(5, 6, 7\), got"),
        (
            lambda A: view_subset(A, [1]).T(torch.zeros(1, 1, 2, 8, 5)),
            r"last sizes \(1, 8, 5\), got \(1, 1, 2, 8, 5\)",
        ),
        (
            lambda A: ray_subset(A, torch.ones(4, 8, 5) > 0).T(torch.zeros(160)),
            r"last sizes \(160,\), got \(160,\)",
        ),
    ],
)
def test_inconsistent_input_is_refused(make, message):
    case = CASES["dome"]
    with pytest.raises(ValueError, match=message):
        make(case.build())
