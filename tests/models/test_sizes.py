"""Grids, detectors and types that are out of the ordinary: each is computed, or refused at the
door.
"""

import pytest
import torch
from mvrecon.models.networks import halved

from mvrecon.geometry.grid import Grid
from mvrecon.parts import CAMERAS, MODELS, PROJECTORS
from mvrecon.projectors.operator import Projector
from tests.models.rig import small_projector
from tests.models.test_single_pass import HEAD

NAMES = tuple(MODELS.names())
SKIPS = ({}, {"support": "hull"}, {"support": "hull", "masked": False})
#: A model and what it may leave out.
WAYS = [
    (name, skip)
    for name in NAMES
    for skip in SKIPS
    if not skip or name in ("single_pass", "backprojection_unet")
]
NETWORKS = ("single_pass", "mean_fusion", "backprojection_unet", "geometry_free")


def _projector(shape: tuple[int, int, int] = (12, 12, 12), pixels: int = 12) -> Projector:
    grid = Grid.centred(shape=shape, spacing=24 / max(shape))
    detector = {"pixels": [pixels, pixels], "pixel_mm": 60 / pixels}
    cameras = CAMERAS.build("circular", n_views=4, sid=100.0, sdd=200.0, detector=detector)
    return PROJECTORS.build("drr", grid=grid, cameras=cameras)


def _stirred(name: str, projector: Projector, **options) -> torch.nn.Module:
    """With random weights everywhere."""
    options |= {"head": HEAD} if name in ("single_pass", "mean_fusion") else {}
    model = MODELS.build(name, projector, **options)
    torch.manual_seed(2)
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return model


def _learns(model: torch.nn.Module, views: torch.Tensor, shape: tuple[int, ...]) -> None:
    """The volume has the grid's shape, all of it and of the gradients is finite, and not all is
    zero.
    """
    volume = model(views).volume
    assert volume.shape == (1, 1, *shape) and volume.isfinite().all() and volume.any()
    if any(parameter.numel() for parameter in model.parameters()):
        volume.square().sum().backward()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize(
    "shape", [(1, 16, 16), (16, 16, 1), (2, 2, 2), (5, 5, 5), (3, 1, 7), (1, 1, 1)]
)
@pytest.mark.parametrize(("name", "skip"), WAYS)
def test_every_model_takes_any_grid(name, skip, shape):
    projector = _projector(shape)
    _learns(_stirred(name, projector, **skip), projector(torch.rand(1, 1, *shape) + 0.1), shape)


@pytest.mark.parametrize(("name", "skip"), WAYS)
def test_every_model_takes_detectors_of_a_few_pixels(name, skip):
    for pixels in (1, 3):
        projector = _projector(pixels=pixels)
        binned = {"opinion": {"binning": pixels}} if name in ("single_pass", "mean_fusion") else {}
        _learns(
            _stirred(name, projector, **skip, **binned),
            projector(torch.rand(1, 1, 12, 12, 12)),
            (12, 12, 12),
        )


def test_a_group_of_one_voxel_is_normalised_to_its_shift():
    projector = _projector((1, 1, 1))
    _learns(
        _stirred("backprojection_unet", projector, width=4),
        projector(torch.ones(1, 1, 1, 1, 1)),
        (1, 1, 1),
    )


@pytest.mark.parametrize("shape", [(1, 4, 3), (1, 1, 1), (5, 2, 1)])
def test_halving_leaves_an_axis_of_one_voxel(shape):
    x = torch.rand(2, 3, *shape, dtype=torch.float64, requires_grad=True)
    mean = torch.stack([part.mean(dim=(2, 3, 4)) for part in x[:, :, :2, :2, :2].split(2, dim=2)])[
        0
    ]
    assert torch.allclose(halved(x)[:, :, 0, 0, 0], mean) and halved(x).shape[2:] == tuple(
        -(-n // 2) for n in shape
    )
    assert torch.autograd.gradcheck(halved, [x])


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("own", [torch.float32, torch.float64])
@torch.no_grad()
def test_a_network_computes_in_the_type_of_its_weights(name, own):
    projector = _projector()
    model = _stirred(name, projector).to(own)
    views = projector(torch.rand(1, 1, 12, 12, 12))
    for theirs in (torch.float32, torch.float64, torch.float16):
        volume = model(views.to(theirs)).volume
        assert volume.dtype == own and torch.equal(volume, model(views.to(theirs).to(own)).volume)


@pytest.mark.parametrize("name", ["sirt", "backprojection"])
def test_a_method_without_weights_keeps_double_views(name):
    projector = _projector()
    views = projector(torch.rand(1, 1, 12, 12, 12, dtype=torch.float64))
    assert _stirred(name, projector)(views).volume.dtype == torch.float64


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_refuses_what_it_cannot_take(name):
    projector = small_projector()
    model, views = _stirred(name, projector), torch.rand(1, 1, 4, 12, 12)
    refused = {
        r"one channel, got \(1, 2, 4, 12, 12\)": views.expand(-1, 2, -1, -1, -1),
        r"at least one sample and one channel, got \(0, ": views[:0],
        "floating point, got torch.int32": views.int(),
        "on cpu, where the projector is, got meta": views.to("meta"),
    }
    for said, bad in refused.items():
        with pytest.raises(ValueError, match=f"Expected views .*{said}"):
            model(bad)
    with pytest.raises(ValueError, match="float32 or float64, got torch.bfloat16"):
        model.bfloat16()(views)
