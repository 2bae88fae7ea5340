"""Sampling whose derivative has an order of additions, against torch's."""

import pytest
import torch
import torch.nn.functional as F

from mvrecon.geometry.lattice import gathered


@pytest.mark.parametrize("shape", [(5, 4, 6), (1, 3, 2)])
def test_gathered_values_and_derivatives_match_grid_sample(shape):
    torch.manual_seed(0)
    volume = torch.randn(2, 3, *shape, dtype=torch.float64, requires_grad=True)
    points = (3 * torch.rand(2, 3, 5, 7, 3, dtype=torch.float64) - 1.5).requires_grad_()
    points.data[0, 0, 0] = 4.0  # where `normalised` puts what does not count
    expected = F.grid_sample(volume, points, align_corners=False)
    samples = gathered(volume, points)
    assert torch.allclose(samples, expected, rtol=0, atol=1e-14)
    onto = torch.randn_like(samples)
    for ours, theirs in zip(
        torch.autograd.grad(samples, (volume, points), onto),
        torch.autograd.grad(expected, (volume, points), onto),
        strict=True,
    ):
        assert theirs.abs().max() > 0 and torch.allclose(ours, theirs, rtol=0, atol=1e-13)


def test_gathered_values_at_voxel_centres_are_the_voxels():
    volume = torch.arange(24.0).reshape(1, 1, 2, 3, 4)
    z, y, x = torch.meshgrid(torch.arange(2), torch.arange(3), torch.arange(4), indexing="ij")
    index = torch.stack([x, y, z], dim=-1).double()
    points = (2 * index + 1) / torch.tensor([4, 3, 2]) - 1
    assert torch.allclose(
        gathered(volume.double(), points[None]), volume.double(), rtol=0, atol=1e-12
    )
