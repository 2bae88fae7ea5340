"""Any reconstructor is a model, and any is a model's start."""

import pytest
import torch

import mvrecon as mv
from mvrecon.parts import MODELS
from mvrecon.testing import check_model
from tests.models.rig import small_projector
from tests.models.test_single_pass import OPTIONS


@pytest.mark.parametrize(
    ("name", "method", "options"),
    [
        ("cgls", mv.cgls, {"iterations": 3}),
        ("fista_tv", mv.fista_tv, {"iterations": 4, "weight": 1e-3}),
        ("osem", mv.osem, {"iterations": 2, "subsets": 2}),
    ],
)
def test_a_classical_model_is_its_method(name, method, options):
    A = small_projector()
    views = A(torch.rand(2, 1, *A.grid.shape))
    model = MODELS.build("classical", A, reconstructor={"name": name, **options})
    assert torch.equal(model(views).volume, method(A, views, **options))


def test_the_model_sirt_is_the_classical_model_of_that_name():
    A = small_projector()
    views = A(torch.rand(1, 1, *A.grid.shape))
    one = MODELS.build("sirt", A, iterations=5)
    other = MODELS.build("classical", A, reconstructor={"name": "sirt", "iterations": 5})
    assert torch.equal(one(views).volume, other(views).volume)


@pytest.mark.parametrize("name", ["single_pass", "backprojection_unet"])
def test_sirt_with_momentum_by_name_is_the_start_by_number(name):
    A = small_projector()
    views = A(torch.rand(2, 1, *A.grid.shape))
    starts = []
    for start in (7, {"name": "sirt", "iterations": 7, "momentum": True}):
        torch.manual_seed(0)
        model = MODELS.build(name, A, **OPTIONS.get(name, {}), start=start).eval()
        starts.append(model(views).start)
    torch.testing.assert_close(starts[0], starts[1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("support", ["none", "hull"])
def test_a_model_that_starts_from_total_variation_keeps_the_contract(support):
    start = {"name": "fista_tv", "iterations": 3, "weight": 1e-2}
    options = {**OPTIONS["single_pass"], "start": start, "support": support}
    check_model("single_pass", small_projector(), **options)


@pytest.mark.parametrize(
    ("reconstructor", "message"),
    [
        ({"name": "fista_vt"}, "did you mean 'fista_tv'"),
        ({"iterations": 3}, "needs a 'name'"),
    ],
)
def test_a_reconstructor_that_there_is_not_is_refused_when_a_model_is_built(reconstructor, message):
    """A model refuses a reconstructor without a name, or of an unknown one, with the nearest."""
    A = small_projector()
    with pytest.raises((LookupError, TypeError), match=message):
        MODELS.build("classical", A, reconstructor=reconstructor)
    with pytest.raises((LookupError, TypeError), match=message):
        MODELS.build("backprojection_unet", A, start=reconstructor)
