import pytest
import torch

from mvrecon.data.scenes.phantoms import SheppLogan, shepp_logan
from mvrecon.geometry.grid import Grid


def test_known_positions_have_known_values():
    """Skull, brain, both ventricles, the upper tumour, air; from the table of Yu, Ye and Wang."""
    head = shepp_logan(half_edge=100, centre=(5, 6, 7), value=2.0)
    places = torch.tensor(
        [[0, 90, 0], [0, -50, 0], [-22, 0, -25], [22, 0, -25], [0, 40, -25], [80, 0, 0]],
        dtype=torch.float64,
    )
    values = head.values(places + torch.tensor([5, 6, 7], dtype=torch.float64))
    torch.testing.assert_close(
        values, 2 * torch.tensor([1.0, 0.2, 0, 0, 0.4, 0], dtype=torch.float64), atol=1e-12, rtol=0
    )


def test_the_ventricles_lean_outwards():
    """Turned by 108 and 72 degrees from +x, their long axes meet above the head: left leans left,
    right leans right.
    """
    head = shepp_logan()
    tilt = lambda x, y: head.values(torch.tensor([x, y, -0.25], dtype=torch.float64)).item()  # noqa: E731
    along = (
        torch.deg2rad(torch.tensor(108.0)).cos().item() * 0.35,
        torch.deg2rad(torch.tensor(108.0)).sin().item() * 0.35,
    )
    assert tilt(-0.22 + along[0], along[1]) == pytest.approx(0, abs=1e-12)
    assert tilt(-0.22 - along[0], along[1]) > 0.1


def test_no_value_is_negative():
    rng = torch.Generator().manual_seed(0)
    xyz = torch.rand(400_000, 3, generator=rng, dtype=torch.float64) * 2 - 1
    assert shepp_logan().values(xyz).min() > -1e-12


def test_there_is_one_case(rig):
    scene, grid = SheppLogan(), Grid.centred(size=(24, 20, 16), spacing=(5.0, 5.0, 7.0))
    assert scene.length == 1
    sample = scene.sample(0, 0, grid, rig)
    assert torch.equal(sample.volume, scene.sample(0, 8, grid, rig).volume)
    assert sample.inside[0, 6, 10, 11] and sample.volume[0, 6, 10, 11] < 0.3
    with pytest.raises(IndexError, match="1 case"):
        scene.sample(1, 0, grid, rig)


def test_invalid_sizes_are_refused():
    with pytest.raises(ValueError, match="positive semi-axes"):
        shepp_logan(half_edge=0)
