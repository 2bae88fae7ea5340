"""Robust SIRT: wrong pixels leave the volume nearly as it is from correct views."""

import pytest
import torch

from mvrecon.core.parts import METHODS
from mvrecon.methods.classical.sirt import robust_sirt, sirt
from mvrecon.testing import check_method
from tests.methods.classical.methods import Dense
from tests.methods.learned.rig import SMALL, ball, small_projector


def dead(views):
    views[:, :, 2, :, 7] = 0


def hot(views):
    views[:, :, 2, :, 7] = views.max()


def cable(views):
    views[:, :, 5, 6:8] += 0.5 * views.max()


def scattered(views):
    views[:, :, 3] *= 0.9


@torch.no_grad()
def test_wrong_pixels_leave_the_volume_within_seven_per_cent_of_that_of_clean_views():
    """Where the error of least squares is at least six times as large."""
    A = small_projector(12, size=16, pixels=16)
    faults, truth = (dead, hot, cable, scattered), ball(16)
    views = A(truth).repeat(5, 1, 1, 1, 1)  # the last is clean
    for fault, wrong in zip(faults, views[:4].split(1), strict=True):
        fault(wrong)
    robust, plain = (
        (volumes[:4] - volumes[4:]).flatten(1).norm(dim=1) / truth.norm()
        for volumes in (robust_sirt(A, views), sirt(A, views, 84, momentum=True))
    )
    assert (robust < 0.07).all() and (robust < plain / 6).all()


@torch.no_grad()
def test_it_begins_as_sirt_and_continues_with_weights_of_any_scale():
    A = Dense()
    views = A(torch.rand(1, 2, *A.domain_shape))
    views[:, 0, 1] += 1.0
    torch.testing.assert_close(robust_sirt(A, views, 6), sirt(A, views, 6, momentum=True))
    volume = robust_sirt(A, views, 20)
    assert not torch.allclose(volume, sirt(A, views, 20, momentum=True), rtol=1e-2)
    assert torch.equal(robust_sirt(A, 0.125 * views, 20), 0.125 * volume)
    assert not robust_sirt(A, 0 * views, 20).any()
    with pytest.raises(ValueError, match="every, a number of at least 1, got 0"):
        robust_sirt(A, views, every=0)


def test_it_is_the_start_of_a_network():
    start = {"name": "robust_sirt", "iterations": 3, "every": 2}
    check_method("world_unet", small_projector(), **{**SMALL["world_unet"], "start": start})
    assert "robust_sirt" in METHODS.names()
