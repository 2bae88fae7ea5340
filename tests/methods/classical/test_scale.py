"""Methods are equivariant to scaling of the views by any factor."""

import pytest
import torch

from mvrecon.methods.classical.least_squares import cgls, tikhonov
from mvrecon.methods.classical.mlem import mlem, osem
from mvrecon.methods.classical.sirt import os_sart, sirt
from mvrecon.testing import homogeneity_gap
from tests.methods.classical.methods import projector, tabulated, truth

#: Methods that are homogeneous: with options that do not depend on the unit of the views.
RUNS = {
    "sirt": lambda A, y, **o: sirt(A, y, 8, momentum=True, **o),
    "os_sart": lambda A, y, **o: os_sart(A, y, 3, **o),
    "cgls": lambda A, y, **o: cgls(A, y, 8, **o),
    "damped cgls": lambda A, y, **o: cgls(A, y, 8, damping=2.0, tolerance=1e-3, **o),
    "tikhonov": lambda A, y, **o: tikhonov(A, y, 8, **o),
    "identity": lambda A, y, **o: tikhonov(A, y, 8, 0.3, penalty="identity", **o),
    "mlem": lambda A, y, **o: mlem(A, y, 5, **o),
    "osem": lambda A, y, **o: osem(A, y, 3, **o),
}


@pytest.mark.pairwise(name=RUNS, dtype=[torch.float32, torch.float64], exponent=[-100, -70, 40])
def test_the_volume_scales_with_the_views(name, dtype, exponent):
    A = tabulated()
    start, factors = truth(A, 2, dtype), [2.0**exponent]
    views = A(start.flip(-1)) + 0.1

    def started(views: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        return RUNS[name](A, views, start=start)

    # what is below the range of float32 is lost at 2^-100
    assert homogeneity_gap(lambda views: RUNS[name](A, views), views, factors=factors) < 1e-6
    assert homogeneity_gap(started, views, start, factors=factors) < 1e-6


def test_samples_of_a_batch_may_differ_in_scale():
    A = projector()
    views = A(truth(A, 2, torch.float32))
    views[1] *= 2.0**-80
    for name in ("cgls", "tikhonov"):
        whole, alone = RUNS[name](A, views), RUNS[name](A, views[1:])
        torch.testing.assert_close(whole[1:] * 2.0**80, alone * 2.0**80, rtol=1e-4, atol=1e-5)


def test_a_monitor_receives_iterates_in_the_unit_of_the_volume():
    A, seen = tabulated(), []
    views = 2.0**-90 * A(truth(A, 1, torch.float32))
    x = cgls(A, views, 5, monitor=lambda iterate: seen.append(iterate))
    assert torch.equal(seen[-1].volume, x)
    torch.testing.assert_close(
        2.0**90 * seen[-1].residual, 2.0**90 * (views - A(x)), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("factor", [2.0**-90, 2.0**40])
def test_the_gradient_of_tikhonov_does_not_depend_on_the_unit_of_the_loss(factor):
    A = tabulated()
    views = A(truth(A, 1, torch.float32)).requires_grad_()
    gradients = [
        torch.autograd.grad((scale * tikhonov(A, views, 8)).sum(), views)[0] / scale
        for scale in (1.0, factor)
    ]
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-5, atol=1e-6)
