"""ItNet's steps towards the data, and the bound of learned primal-dual."""

import pytest
import torch

from mvrecon.methods.classical.fdk import fbp
from mvrecon.methods.classical.total_variation import power_norm
from mvrecon.methods.method import build_method
from mvrecon_baselines.breast import BreastSlices
from mvrecon_baselines.unrolled import ItNet, growth, norm_bound


@torch.no_grad()
def test_untrained_itnet_iterates_fbp_of_the_residual(fan):
    A = fan()
    y = BreastSlices(detail=3).sample(0, 0, A.grid, A.cameras).views[None]
    volume = ItNet(iterations=2, width=4, levels=3)(y, A).volume
    x = fbp(A, y)
    for _ in range(2):
        x = x + fbp(A, y - A(x)) / growth(A)
    assert (volume - x).abs().max() < 1e-5 * x.abs().max()


@torch.no_grad()
def test_steps_of_inverse_growth_are_stable_where_unit_steps_diverge(fan):
    torch.manual_seed(0)
    A, x = fan(), torch.rand(1, 1, 1, 16, 16)
    full, short, most = x, x, growth(A)
    for _ in range(30):
        full = full - fbp(A, A(full))
        short = short - fbp(A, A(short)) / most
    assert most > 2
    assert short.norm() < 2 * x.norm() < 1e-3 * full.norm()


@pytest.mark.parametrize("rig", ["fan", "stack", "cone"])
def test_the_norm_bound_is_tight(rig, request):
    A = request.getfixturevalue(rig)()
    assert 1 <= norm_bound(A).item() / power_norm(A) < 1.5


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("itnet", {"iterations": 0}),
        ("itnet", {"memory": -1}),
        ("primal_dual", {"iterations": 0}),
        ("primal_dual", {"channels": 1}),
    ],
)
def test_too_few_iterations_or_channels_are_refused(name, options):
    """An unrolled method refuses too few iterations or channels."""
    with pytest.raises(ValueError, match="at least"):
        build_method({"name": name, **options})
