"""Methods by name: a classical one is its function, an unknown one is refused."""

import pytest
import torch

import mvrecon as mv
from mvrecon.methods.method import build_method
from mvrecon.operators.operator import PerSample
from tests.methods.classical.methods import NAMES
from tests.methods.learned.rig import small_projector

GRID = mv.Grid.centred(8, spacing=4.0)
DETECTOR = {"pixels": [10, 10], "pixel_mm": 8.0}


@pytest.mark.parametrize(
    ("name", "method", "options"),
    [
        ("cgls", mv.cgls, {"iterations": 3}),
        ("fista_tv", mv.fista_tv, {"iterations": 4, "weight": 1e-3}),
        ("osem", mv.osem, {"iterations": 2, "subsets": 2}),
    ],
)
def test_a_classical_method_is_its_function(name, method, options):
    A = small_projector()
    views = A(torch.rand(2, 1, *A.grid.shape))
    volume = build_method({"name": name, **options})(views, A).volume
    assert torch.equal(volume, method(A, views, **options))


def test_each_sample_of_a_batch_of_operators_is_reconstructed_with_its_own():
    operators = [small_projector(), 3.0 * small_projector()]
    A, x = PerSample(operators), torch.rand(2, 1, 12, 12, 12)
    views = A(x)
    volume = build_method({"name": "sirt", "iterations": 4})(views, A).volume
    for i, B in enumerate(operators):
        assert torch.equal(volume[i : i + 1], mv.sirt(B, views[i : i + 1], 4))


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        ({"name": "fista_vt"}, LookupError, "did you mean 'fista_tv'"),
        ({"iterations": 3}, TypeError, "needs a 'name'"),
        ({"name": "uncertain", "method": {"name": "sirtt"}}, LookupError, "did you mean 'sirt'"),
        (
            {"name": "aligned", "method": {"name": "sirt"}, "alternation": 2},
            TypeError,
            "did you mean 'alternations'",
        ),
    ],
)
def test_an_unknown_method_is_refused_with_the_nearest(config, error, message):
    """Also the method inside another one."""
    with pytest.raises(error, match=message):
        build_method(config)


def test_the_operator_matches_the_beam():
    x = torch.rand(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(0))
    for A in (
        mv.Drr(GRID, mv.circular(4, 200.0, 400.0, DETECTOR)),
        mv.Radon(GRID, mv.parallel(4, DETECTOR)),
    ):
        views = A(x)
        volume = mv.reconstruct(views, A.cameras, GRID, "sirt", iterations=3)
        assert torch.equal(volume, mv.sirt(A, views, iterations=3))
        assert mv.reconstruct(views.double(), A.cameras, GRID, "cgls").dtype == torch.float64
        small = {"widths": [4], "start": 2}
        assert mv.reconstruct(views, A.cameras, GRID, "world_unet", **small).shape == x.shape


def test_a_method_built_by_name_has_the_gradient_of_its_function():
    A = small_projector()
    views = A(torch.rand(1, 1, 12, 12, 12)).requires_grad_()
    (expected,) = torch.autograd.grad(mv.fdk(A, views).square().sum(), views)
    volume = mv.reconstruct(views, A.cameras, A.grid, "fdk")
    torch.testing.assert_close(torch.autograd.grad(volume.square().sum(), views)[0], expected)


def test_inconsistent_input_is_refused_with_a_remedy():
    cameras = mv.circular(4, 200.0, 400.0, DETECTOR)
    views = torch.ones(1, 1, 4, 10, 10)
    with pytest.raises(LookupError, match="did you mean 'sirt'"):
        mv.reconstruct(views, cameras, GRID, "sird")
    with pytest.raises(TypeError, match="did you mean 'iterations'"):
        mv.reconstruct(views, cameras, GRID, "sirt", iteration=3)
    with pytest.raises(ValueError, match=r"got \(4, 10, 10\); .* use x\[None, None\]"):
        mv.Drr(GRID, cameras).T(views[0, 0])
    with pytest.raises(TypeError, match="got ndarray; torch.as_tensor makes one"):
        mv.Drr(GRID, cameras).T(views.numpy())


@pytest.mark.pairwise(method=[*NAMES, "fbp", "fdk", "finer"], shape=[(0, 1), (1, 0)])
def test_an_empty_batch_is_refused_by_every_method(method, shape):
    flat = method == "fbp"
    rig = mv.parallel(4, DETECTOR) if flat else mv.circular(4, 200.0, 400.0, DETECTOR)
    views = torch.zeros(*shape, 4, 10, 10)
    with pytest.raises(
        ValueError, match=rf"at least one sample .*, got \({shape[0]}, {shape[1]}, "
    ):
        mv.reconstruct(views, rig, GRID, method)
