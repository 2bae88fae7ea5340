"""A bound at zero whose gradient is the projected one."""

import torch

from mvrecon.models.nonnegative import nonnegative


def test_values_are_cut_off_and_gradients_lead_back_alone():
    x = torch.tensor([-2.0, -2.0, 0.0, 0.0, 3.0, 3.0], requires_grad=True)
    y = nonnegative(x)
    assert torch.equal(y, x.clamp_min(0))
    y.backward(torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0]))
    assert x.grad.tolist() == [-1.0, 0.0, -1.0, 0.0, -1.0, 1.0]


def test_above_zero_it_is_differentiable():
    x = (0.1 + torch.rand(5, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(nonnegative, x)


def test_descent_from_below_zero_ends_at_the_minimum_where_plain_cutting_stays():
    """The least of (max(x, 0) - 1)^2 for three beginnings."""
    for cut, end in ((nonnegative, 1.0), (torch.relu, -0.5)):
        x = torch.tensor([-0.5, -0.5, -0.5], requires_grad=True)
        descent = torch.optim.SGD([x], lr=0.1)
        for _ in range(100):
            descent.zero_grad()
            (cut(x) - 1).square().sum().backward()
            descent.step()
        torch.testing.assert_close(x.detach(), torch.full((3,), end), atol=1e-3, rtol=0)
