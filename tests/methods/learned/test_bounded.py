"""A bound whose gradient is the projected one."""

from functools import partial

import torch

from mvrecon.methods.learned.start import clamped

within_one = partial(clamped, most=1.0)


def test_values_are_clamped_and_gradients_beyond_a_bound_only_point_back():
    x = torch.tensor([-2.0, -2.0, 0.0, 0.0, 0.3, 0.3, 1.0, 1.0, 3.0, 3.0], requires_grad=True)
    y = within_one(x)
    assert torch.equal(y, x.clamp(0, 1))
    y.backward(torch.tensor([-1.0, 1.0] * 5))
    assert x.grad.tolist() == [-1.0, 0.0, -1.0, 0.0, -1.0, 1.0, 0.0, 1.0, 0.0, 1.0]


def test_between_the_bounds_it_is_differentiable():
    x = (0.1 + 0.8 * torch.rand(5, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(within_one, x)


def test_descent_from_beyond_a_bound_reaches_the_minimum_unlike_plain_clamping():
    """The least of (x - 0.5)^2 from beside either bound."""
    for cut, end in ((within_one, [0.5, 0.5]), (lambda x: x.clamp(0, 1), [-0.2, 1.2])):
        x = torch.tensor([-0.2, 1.2], requires_grad=True)
        descent = torch.optim.SGD([x], lr=0.1)
        for _ in range(100):
            descent.zero_grad()
            (cut(x) - 0.5).square().sum().backward()
            descent.step()
        torch.testing.assert_close(x.detach(), torch.tensor(end), atol=1e-3, rtol=0)
