"""What torch thinks of the operators: schema, fake tensors, compiled graphs, maps over batches."""

import pytest
import torch
from torch.library import opcheck

from mvrecon.kernels.rays import ops
from tests.operators.cases import CASES, DIFFERENTIABLE, METHODS, OPTIONS, noise


@pytest.fixture(autouse=True)
def fresh_graphs():
    """Forgets the graphs of other projectors, of which torch keeps but a few."""
    torch.compiler.reset()


CHECKS = (
    "test_schema",
    "test_autograd_registration",
    "test_faketensor",
    "test_aot_dispatch_static",
)


def arguments(kind: str, option: str, dtype: torch.dtype):
    """Volume, views, rays, window, detector, shape and method of a case, as the operators take
    them.
    """
    case = DIFFERENTIABLE[kind]
    A = case.build(**OPTIONS[option])
    x, y = (each[:, 0].to(dtype) for each in noise(case))
    y = y.reshape(2, len(A.lines), *A.detector)
    return x, y, A.lines, A.ray_extent, A.detector, list(case.grid.shape), A.kernel


# a method is a string of the operator, to which neither schema nor fake tensors look: the others
# are in one dtype
@pytest.mark.parametrize(
    ("option", "dtype"),
    [
        *(("joseph", torch.float64), ("joseph", torch.float32)),
        *(("joseph", torch.float16), ("joseph", torch.bfloat16)),
        *(("siddon", torch.float64), ("samples", torch.float64)),
    ],
)
@pytest.mark.parametrize("kind", ["cone", "explicit"])
def test_torch_accepts_the_operators(kind, option, dtype):
    x, y, lines, window, detector, shape, method = arguments(kind, option, dtype)
    y = y if dtype.itemsize > 2 else y.float()
    volume, views, rays = (each.clone().requires_grad_() for each in (x, y, lines))
    # the derivative by a half volume is rounded twice on one way and once on the other
    checks = CHECKS if dtype.itemsize > 2 else CHECKS[:3]
    opcheck(
        torch.ops.mvrecon.project.default,
        (volume, rays, window, detector, method),
        test_utils=checks,
    )
    opcheck(
        torch.ops.mvrecon.backproject.default,
        (views, rays, window, shape, method),
        test_utils=checks,
    )
    opcheck(
        torch.ops.mvrecon.lines_vjp.default, (x, y, lines, window, method), test_utils=CHECKS[:3]
    )


@pytest.mark.pairwise(kind=["cone", "dome", "stack", "explicit"], option=OPTIONS)
def test_a_compiled_graph_contains_the_operators_without_breaks(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    x, y = noise(case, torch.float32)
    x.requires_grad_()

    def step(x: torch.Tensor) -> torch.Tensor:
        return A.T((A(x.sin()) - y).tanh()).exp2()

    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
    assert torch.allclose(compiled(x), step(x))
    expected, found = (
        torch.autograd.grad(run(x).log().square().sum(), x)[0] for run in (step, compiled)
    )
    assert expected.norm() > 1 and torch.allclose(
        found, expected, rtol=1e-4, atol=1e-5 * expected.abs().max()
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_compiled_graph_differentiates_by_the_rays(method):
    x, y, lines, window, detector, _, kernel = arguments("cone", method, torch.float64)

    def step(lines: torch.Tensor) -> torch.Tensor:
        return (ops.project(x, 1.001 * lines, window, detector, kernel) * y).sum()

    lines.requires_grad_()
    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
    expected, found = (torch.autograd.grad(run(lines), lines)[0] for run in (step, compiled))
    assert expected.norm() > 0.1 and torch.allclose(found, expected)


@pytest.mark.pairwise(1, kind=["cone", "dome", "explicit"], option=OPTIONS)
def test_vmap_over_volumes_and_views_equals_a_loop(kind, option):
    case = CASES[kind]
    A = case.build(**OPTIONS[option])
    x, y = noise(case, channels=3)
    for act, values in ((A, x), (A.T, y)):
        loop = torch.stack([act(each[None]) for each in values])
        assert torch.allclose(torch.func.vmap(act)(values[:, None]), loop, rtol=1e-13)
        mapped = torch.func.vmap(act, in_dims=1, out_dims=1)(values[None])
        assert torch.allclose(mapped, loop.transpose(0, 1), rtol=1e-13)
        # a map in a map
        each = torch.func.vmap(torch.func.vmap(act))(values[:, :, None, None])
        assert torch.allclose(each[:, :, 0, 0], loop[:, 0], rtol=1e-13)


@pytest.mark.pairwise(2, kind=["cone", "explicit"], option=OPTIONS)
def test_vmap_over_rays_equals_a_loop(kind, option):
    x, y, lines, window, detector, shape, method = arguments(kind, option, torch.float64)
    several = torch.stack([lines, 1.01 * lines, lines.roll(1, dims=0)], dim=1)
    calls = {
        "project": (lambda x, lines: ops.project(x, lines, window, detector, method), x),
        "backproject": (lambda y, lines: ops.backproject(y, lines, window, shape, method), y),
        "lines_vjp": (lambda x, lines: ops.lines_vjp(x, y, lines, window, method), x),
    }
    for name, (act, values) in calls.items():
        loop = torch.stack([act(values, each) for each in several.unbind(1)])
        assert torch.equal(torch.func.vmap(act, in_dims=(None, 1))(values, several), loop), name
        many = torch.stack([values, 2 * values, -values])
        loop = torch.stack([act(*each) for each in zip(many, several.unbind(1), strict=True)])
        assert torch.equal(torch.func.vmap(act, in_dims=(0, 1))(many, several), loop), name
    mapped = torch.func.vmap(lambda y: ops.lines_vjp(x, y, lines, window, method))(
        torch.stack([y, 3 * y])
    )
    assert torch.allclose(mapped[1], 3 * mapped[0])


def test_derivatives_pass_through_a_map():
    case = CASES["cone"]
    A = case.build()
    x, _ = noise(case)
    x.requires_grad_()
    mapped, whole = (
        torch.autograd.grad(views.cos().sum(), x)[0]
        for views in (torch.func.vmap(A)(x[:, None]), A(x))
    )
    assert torch.allclose(mapped, whole)
