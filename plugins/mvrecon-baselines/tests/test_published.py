"""The 3-D U-Nets of the literature have the published sizes, and see as far as their convolutions
reach.
"""

import pytest
import torch

from mvrecon.core.parts import NETWORKS
from mvrecon_baselines.published import valid_size

NORMS = (torch.nn.BatchNorm3d, torch.nn.GroupNorm)
SMALL = {
    "unet3d": {"width": 2, "levels": 3, "norm": "group", "padding": "same"},
    "residual_unet3d": {"width": 2, "levels": 3},
}


def _counts(network: torch.nn.Module) -> tuple[int, int]:
    """Parameters of a network's convolutions, and of its normalisation."""
    norm = sum(p.numel() for m in network.modules() if isinstance(m, NORMS) for p in m.parameters())
    return sum(p.numel() for p in network.parameters()) - norm, norm


def test_the_published_u_net_has_the_published_sizes():
    """Cicek and others, MICCAI 2016, section 2: 19 069 955 parameters, a tile of 132 x 132 x 116
    voxels and 3 channels to 44 x 44 x 28 and 3 labels.
    """
    with torch.device("meta"):
        network = NETWORKS.build("unet3d", 3, 3).eval()
        assert _counts(network)[0] == 19_069_955
        assert network(torch.empty(1, 3, 116, 132, 132)).shape == (1, 3, 28, 44, 44)
        assert _counts(NETWORKS.build("unet3d", 3, 3, norm="none")) == (19_069_955, 0)


def test_the_residual_u_net_has_exactly_its_published_layers():
    """From each level's channels: three cubic convolutions of a block, a pointwise one before it,
    one up-convolution, and two normalisations with a scale and a shift.
    """
    c = [64, 128, 256, 512, 1024]
    blocks = 2 * sum(27 * n * n for n in c) + 2 * sum(27 * n * n for n in c[:-1])
    widening = sum(a * b + b for a, b in zip([1, *c], c, strict=False))
    up = sum(27 * a * b for a, b in zip(c, c[1:], strict=False))
    norm = 4 * (sum(c) + sum(c[:-1]))
    with torch.device("meta"):
        network = NETWORKS.build("residual_unet3d", 1, 2)
    assert _counts(network) == (blocks + widening + up + 2 * 64 + 2, norm)


def test_valid_convolutions_of_a_tile_equal_those_of_the_whole_volume():
    """With "valid" padding, the centre of a larger tile's output equals the output of a smaller
    tile. Tiles differ by a multiple of the pooling factor.
    """
    torch.manual_seed(0)
    network = NETWORKS.build("unet3d", 1, 2, width=2, levels=2, norm="none").double()
    x = torch.randn(1, 1, 24, 20, 22, dtype=torch.float64)
    whole, part = network(x), network(x[..., 2:-2, :, 2:])
    assert part.shape[2:] == tuple(valid_size(n, 2) for n in (20, 20, 20))
    assert torch.allclose(part, whole[..., 2:-2, :, 2:], atol=1e-12) and part.std() > 0


@pytest.mark.parametrize("size", [(1, 1, 7), (5, 6, 9), (8, 4, 12)])
@pytest.mark.parametrize("name", SMALL)
def test_padded_networks_keep_any_size(name, size):
    assert NETWORKS.build(name, 2, 3, **SMALL[name])(torch.rand(1, 2, *size)).shape == (1, 3, *size)


@pytest.mark.parametrize("name", SMALL)
def test_derivatives_equal_finite_differences(name):
    torch.manual_seed(0)
    network = NETWORKS.build(name, 1, 1, **SMALL[name]).double()
    x, step = torch.randn(2, 1, 1, 3, 5, 4, dtype=torch.float64)
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(network(x).square().sum(), x)
    with torch.no_grad():
        above, below = (network(x + h * step).square().sum() for h in (1e-6, -1e-6))
    slope = (above - below) / 2e-6
    assert torch.isclose((gradient * step).sum(), slope, rtol=1e-5) and slope.abs() > 1e-3


def test_an_odd_size_is_refused_with_the_next_valid_size():
    """A tile whose pooled sizes are odd, or smaller than the border, is refused with the next
    larger size that fits.
    """
    network = NETWORKS.build("unet3d", 1, 1, width=1)
    for size, larger in ((131, 132), (104, 108), (8, 92)):
        with pytest.raises(ValueError, match=f"got {size} voxels, .* fits is {larger};"):
            network(torch.zeros(1, 1, 132, size, 132))
    assert valid_size(132, 4) == 44 and valid_size(116, 4) == 28


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "layer"}, "norm must be one of batch, group, none, got 'layer'"),
        ({"padding": "reflect"}, "padding must be one of valid, same, got 'reflect'"),
        ({"levels": 0}, "got width=32, levels=0"),
    ],
)
def test_unknown_u_net_options_are_refused(options, message):
    """A U-Net's unknown normalisation or padding, or no level at all, is refused."""
    with pytest.raises(ValueError, match=message):
        NETWORKS.build("unet3d", 1, 1, **options)
