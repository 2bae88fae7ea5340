"""Grids, detectors, types and units that are out of the ordinary."""

import pytest
import torch

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.grid import Grid
from mvrecon.operators.operator import Projector
from tests.methods.learned.rig import SMALL, small_projector, stirred
from tests.methods.learned.test_contract import OPTIONS

pytestmark = pytest.mark.filterwarnings("ignore:Rays are up to")
NETWORKS = tuple(SMALL)
#: A method and further options.
WAYS = [*((name, {}) for name in NETWORKS), ("cross_view", {"support": "hull", "crop": True})]


def projector(shape: tuple[int, int, int] = (12, 12, 12), pixels: int = 12) -> Projector:
    grid = Grid.centred(shape=shape, spacing=24 / max(shape))
    detector = {"pixels": [pixels, pixels], "pixel_mm": 60 / pixels}
    cameras = CAMERAS.build("circular", n_views=4, sid=100.0, sdd=200.0, detector=detector)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


def learns(method: torch.nn.Module, A: Projector, views: torch.Tensor) -> None:
    """The volume has the grid's shape, all of it and of the gradients is finite, and not all is
    zero.
    """
    volume = method(views, A).volume
    assert volume.shape == (1, 1, *A.grid.shape) and volume.isfinite().all() and volume.any()
    volume.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in method.parameters() if p.grad is not None)


@pytest.mark.pairwise(way=WAYS, shape=[(1, 16, 16), (2, 2, 2), (5, 5, 5), (3, 1, 7), (1, 1, 1)])
def test_every_network_supports_any_grid(way, shape):
    name, options = way
    A = projector(shape)
    learns(stirred(name, **options), A, A(torch.rand(1, 1, *shape)))


@pytest.mark.pairwise(1, way=WAYS, pixels=[1, 2, 3])
def test_every_network_supports_detectors_of_a_few_pixels(way, pixels):
    name, options = way
    A = projector(pixels=pixels)
    learns(stirred(name, **options), A, A(torch.rand(1, 1, 12, 12, 12)))


@pytest.mark.pairwise(own=[torch.float32, torch.float64], name=NETWORKS)
@torch.no_grad()
def test_a_network_computes_in_the_dtype_of_its_weights(name, own):
    A = small_projector()
    method = stirred(name).to(own)
    views = A(torch.rand(1, 1, 12, 12, 12))
    for theirs in (torch.float32, torch.float64, torch.float16):
        volume = method(views.to(theirs), A).volume
        assert volume.dtype == own
        assert torch.equal(volume, method(views.to(theirs).to(own), A).volume)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_refuses_unsupported_views(name):
    A = small_projector()
    method, views = stirred(name), torch.rand(1, 1, 4, 12, 12)
    refused = {
        r"one channel, got \(1, 2, 4, 12, 12\)": views.expand(-1, 2, -1, -1, -1),
        r"at least one sample and one channel, got \(0, ": views[:0],
        "floating point, got torch.int32": views.int(),
        "on cpu, where the projector is, got meta": views.to("meta"),
    }
    for message, bad in refused.items():
        with pytest.raises(ValueError, match=f"Expected views .*{message}"):
            method(bad, A)
    with pytest.raises(ValueError, match="float32 or float64, got torch.bfloat16"):
        method.bfloat16()(views, A)


@torch.no_grad()
def volume_in_units(name: str, mm: float, dtype: torch.dtype, options: dict) -> torch.Tensor:
    """Of a scene whose every length is so many times as great, and its attenuation as many times
    smaller.
    """
    grid = Grid.centred((12, 12, 12), 2.0 * mm, centre=(mm, 0.0, 0.0))
    detector = {"pixels": [12, 12], "pixel_mm": 5.0 * mm}
    cameras = CAMERAS.build(
        "circular", n_views=4, sid=100.0 * mm, sdd=200.0 * mm, detector=detector
    )
    A = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    volume = torch.zeros(1, 1, 12, 12, 12, dtype=dtype)
    volume[..., 3:9, 4:8, 3:8] = torch.rand(
        6, 4, 5, generator=torch.Generator().manual_seed(1), dtype=dtype
    )
    return mm * stirred(name, **OPTIONS.get(name, {}) | options).to(dtype)(A(volume / mm), A).volume


#: Methods whose options have no unit, as a weight of a penalty has one.
UNITLESS = [
    *WAYS,
    *((name, {}) for name in ("uncertain", "aligned", "backprojection", "fdk", "sirt", "osem")),
]


@pytest.mark.pairwise(way=UNITLESS, dtype=[torch.float32, torch.float64])
def test_the_unit_of_length_does_not_matter(way, dtype):
    """To rounding, and where no number is rounded, to the bit."""
    name, options = way
    expected = volume_in_units(name, 1.0, dtype, options)
    assert expected.any()
    for mm in (10.0, 1e-3):
        volume = volume_in_units(name, mm, dtype, options)
        assert (volume - expected).abs().max() <= 1e-5 * expected.abs().max()
    assert torch.equal(volume_in_units(name, 2.0**-10, dtype, options), expected)
