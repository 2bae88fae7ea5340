"""Gradients of methods in the views are those of finite differences, or refused: not zero, nor of a
part of the method.

Also tried so: batches of one and three; one row; views of zero, of one lost view, with an empty
case, of 1e12 and 1e-12, negative, with rows of rounding, and a saturated view.
"""

import pytest
import torch

from mvrecon.methods.method import build_method
from mvrecon.testing.measures import gradient_gap
from tests.methods.learned.rig import SMALL, small_projector, stirred

RATIO = {"steps": 2, "noise": "poisson"}
DIFFERENTIABLE = {
    "backprojection": {},
    "sirt": {"iterations": 3, "momentum": True},
    "fdk": {},
    "finer": {"method": {"name": "fdk"}},
    "world_unet": {},
    "world_unet of sirt": {"start": {"name": "sirt", "iterations": 2}},
    "world_unet of counts": {"consistency": RATIO},
    "mean_fusion": {},
    "geometry_free": {},
}
REFUSED = {
    "aligned": {"method": {"name": "sirt"}},
    "trained": {"checkpoint": "of_another_run"},
    "mlem": {},
    "cgls": {},
    "world_unet of osem": {"start": {"name": "osem", "iterations": 1}},
}


def positive(A):
    views = A(torch.rand(2, 1, *A.grid.shape, generator=torch.Generator().manual_seed(0)).double())
    return (views + 0.1 * views.mean()).requires_grad_()


@pytest.mark.parametrize("name", DIFFERENTIABLE)
@pytest.mark.parametrize("training", [False, True])
def test_gradients_in_the_views_are_those_of_finite_differences(name, training):
    A, (method, *_) = small_projector(size=8, pixels=8), name.split()
    module = stirred(method, **DIFFERENTIABLE[name]).double().train(training)
    gap = gradient_gap(lambda y: module(y, A).volume, positive(A), directions=2)
    assert gap < 1e-6


@pytest.mark.parametrize("name", REFUSED)
def test_views_that_require_a_gradient_are_refused_where_there_is_none(name):
    A, (method, *_) = small_projector(), name.split()
    module = build_method({"name": method, **SMALL.get(method, {}), **REFUSED[name]})
    with pytest.raises(ValueError, match="Expected tensors without gradient for"):
        module(positive(A), A)


def test_gradients_of_depths_are_finite_where_the_start_is_empty():
    """Of a lost view, a case of zeros and half a view, whose rays meet voxels of zero alone."""
    A, method = small_projector(), stirred("cross_view")
    views = positive(A).detach().float().repeat(2, 1, 1, 1, 1)[:3]
    views[0], views[1, :, 2], views[2, ..., 6:] = 0, 0, 0
    views.requires_grad_()
    (slope,) = torch.autograd.grad(method(views, A).volume.square().sum(), views)
    assert slope.isfinite().all() and slope[1:].any()
