"""A method by its name, from views, cameras and a grid, is the method on their operator."""

import pytest
import torch

import mvrecon as mv
from tests.reconstructors.methods import NAMES

GRID = mv.Grid.centred(8, spacing=4.0)
DETECTOR = {"pixels": [10, 10], "pixel_mm": 8.0}


def test_the_operator_is_that_of_the_beam():
    x = torch.rand(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(0))
    for A in (
        mv.Drr(GRID, mv.circular(4, 200.0, 400.0, DETECTOR)),
        mv.Radon(GRID, mv.parallel(4, DETECTOR)),
    ):
        views = A(x)
        volume = mv.reconstruct(views, A.cameras, GRID, "sirt", iterations=3)
        assert torch.equal(volume, mv.sirt(A, views, iterations=3))
        assert mv.reconstruct(views.double(), A.cameras, GRID, "cgls").dtype == torch.float64


def test_what_does_not_fit_is_answered_with_what_to_do():
    cameras = mv.circular(4, 200.0, 400.0, DETECTOR)
    views = torch.ones(1, 1, 4, 10, 10)
    with pytest.raises(LookupError, match="did you mean 'sirt'"):
        mv.reconstruct(views, cameras, GRID, "sird")
    with pytest.raises(TypeError, match="did you mean 'iterations'"):
        mv.reconstruct(views, cameras, GRID, "sirt", iteration=3)
    with pytest.raises(ValueError, match=r"got \(4, 10, 10\); .* take x\[None, None\]"):
        mv.Drr(GRID, cameras).T(views[0, 0])
    with pytest.raises(TypeError, match="got ndarray; torch.as_tensor makes one"):
        mv.Drr(GRID, cameras).T(views.numpy())


@pytest.mark.parametrize("shape", [(0, 1), (1, 0)])
@pytest.mark.parametrize("method", [*NAMES, "fbp", "fdk", "finer"])
def test_an_empty_batch_is_refused_by_every_method(method, shape):
    flat = method == "fbp"
    rig = mv.parallel(4, DETECTOR) if flat else mv.circular(4, 200.0, 400.0, DETECTOR)
    views = torch.zeros(*shape, 4, 10, 10)
    with pytest.raises(
        ValueError, match=rf"at least one sample .*, got \({shape[0]}, {shape[1]}, "
    ):
        mv.reconstruct(views, rig, GRID, method)
