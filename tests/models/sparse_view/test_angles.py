"""Views between measured ones: where their cameras are, and what they see."""

import pytest
import torch

from mvrecon.models.sparse_view.angles import AngularUpsampling
from tests.models.sparse_view.conftest import fan, stack


def close(one, other) -> bool:
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("source", "origin", "u", "v")]
    return all(torch.allclose(a, b, atol=1e-9) for a, b in pairs)


def test_a_whole_turn_gets_the_rig_of_as_many_views_more():
    sparse, dense = fan(views=8), fan(views=24)
    upsampling = AngularUpsampling.of(sparse.cameras, sparse.grid, 3)
    assert upsampling.closed and close(upsampling.cameras, dense.cameras)


def test_an_open_scan_gets_none_behind_its_last_view():
    sparse, dense = stack(views=6), stack(views=12)
    upsampling = AngularUpsampling.of(sparse.cameras, sparse.grid, 2)
    assert not upsampling.closed and len(upsampling.cameras) == 11
    assert close(upsampling.cameras, dense.cameras[:11])


def test_shuffled_views_are_put_in_order():
    A = fan(views=8)
    views, shuffle = A(torch.rand(1, 1, *A.grid.shape)), torch.randperm(8)
    plain = AngularUpsampling.of(A.cameras, A.grid, 2)
    shuffled = AngularUpsampling.of(A.cameras[shuffle], A.grid, 2)
    first = int((shuffled.cameras.source - plain.cameras.source[0]).norm(dim=1).argmin())
    assert close(plain.cameras, shuffled.cameras[torch.arange(16).roll(-first)])
    assert torch.equal(plain(views), shuffled(views[:, :, shuffle]).roll(-first, dims=2))


def test_measured_views_stay_and_a_disc_looks_the_same_from_between():
    sparse, dense = fan(views=32), fan(views=64)
    i = torch.arange(16) - 7.5
    disc = (1 - torch.hypot(i[:, None], i) / 5).clamp_min(0)[None, None, None]
    upsampling = AngularUpsampling.of(sparse.cameras, sparse.grid, 2)
    views, expected = upsampling(sparse(disc)), dense(disc)
    assert torch.equal(views[:, :, ::2], sparse(disc))
    assert (views - expected).abs().max() < 0.02 * expected.max()


def test_a_factor_below_one_is_refused():
    """A number of views below the measured one is refused."""
    A = fan()
    with pytest.raises(ValueError, match="at least 1 for views, got 0"):
        AngularUpsampling.of(A.cameras, A.grid, 0)
