"""Leave-one-out residuals: small where the views agree, largest at the camera that is wrong."""

from functools import partial

import pytest
import torch

from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.classical.stopping import left_out_residual
from tests.methods.learned.rig import small_projector

METHOD = partial(sirt, iterations=20, momentum=True)


def test_the_wrong_camera_has_the_largest_residual_and_others_see_it_too():
    A = small_projector(n_views=8)
    volume = torch.zeros(2, 1, *A.grid.shape)
    volume[..., 3:9, 3:8, 4:9] = 1
    views = A(volume)
    plain = left_out_residual(METHOD, A, views)
    wrong = views.clone()
    wrong[:, :, 5] = wrong[:, :, 5].roll(2, dims=-1)
    residual = left_out_residual(METHOD, A, wrong)
    assert plain.max() < 0.2 and (residual.argmax(dim=1) == 5).all()
    assert (residual.mean(dim=1) > 1.5 * plain.mean(dim=1)).all()


def test_the_left_out_residual_is_the_error_of_an_unseen_view():
    A = small_projector(n_views=3)
    views = A(torch.rand(1, 1, *A.grid.shape))
    seen = []

    def nothing(operator, rest):
        seen.append(tuple(rest.shape))
        return rest.new_zeros(1, 1, *operator.domain_shape)

    torch.testing.assert_close(left_out_residual(nothing, A, views), torch.ones(1, 3))
    assert seen == [(1, 1, 2, *views.shape[-2:])] * 3


def test_a_single_view_cannot_be_compared_with_others():
    """Leave-one-out residuals need two views, and finite values."""
    A = small_projector(n_views=2)
    with pytest.raises(ValueError, match="finite"):
        left_out_residual(METHOD, A, torch.full((1, 1, *A.range_shape), torch.nan))
    with pytest.raises(ValueError, match="two views"):
        one = small_projector(n_views=1)
        left_out_residual(METHOD, one, torch.ones(1, 1, *one.range_shape))
