"""Methods by name: a classical one is its function, an unknown one is refused."""

import pytest
import torch

import mvrecon as mv
from mvrecon.models.method import build_method
from mvrecon.projectors.operator import PerSample
from tests.models.rig import small_projector


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
            {"name": "aligned", "method": {"name": "sirt"}, "correct": {"name": "aling"}},
            LookupError,
            "did you mean 'align'",
        ),
    ],
)
def test_an_unknown_method_is_refused_with_the_nearest(config, error, message):
    """Also the method inside another one."""
    with pytest.raises(error, match=message):
        build_method(config)
