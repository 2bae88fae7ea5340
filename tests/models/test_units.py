"""No model knows the unit of length: the same scene in another one has the same answer."""

import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.models.output import Reconstruction
from mvrecon.parts import CAMERAS, MODELS, PROJECTORS
from tests.models.test_sizes import SKIPS, _stirred

WAYS = [
    (name, skip)
    for name in MODELS.names()
    for skip in SKIPS[:2]
    if not skip or name == "single_pass"
]


@torch.no_grad()
def _answer(name: str, mm: float, dtype: torch.dtype, skip: dict) -> Reconstruction:
    """Of a scene whose every length is so many times as great, and its attenuation as many times
    smaller.
    """
    grid = Grid.centred((12, 12, 12), 2.0 * mm, centre=(mm, 0.0, 0.0))
    detector = {"pixels": [12, 12], "pixel_mm": 5.0 * mm}
    cameras = CAMERAS.build(
        "circular", n_views=4, sid=100.0 * mm, sdd=200.0 * mm, detector=detector
    )
    projector = PROJECTORS.build("drr", grid=grid, cameras=cameras)
    torch.manual_seed(0)
    model = _stirred(name, projector, **skip).to(dtype).eval()
    volume = torch.zeros(1, 1, 12, 12, 12, dtype=dtype)
    volume[..., 3:9, 4:8, 3:8] = torch.rand(
        6, 4, 5, generator=torch.Generator().manual_seed(1), dtype=dtype
    )
    return model(projector(volume / mm))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("name", "skip"), WAYS)
def test_the_unit_of_length_does_not_matter(name, skip, dtype):
    """To rounding, also that of SIRT's sums, which are float32; where no number is rounded, to the
    bit.
    """
    expected = _answer(name, 1.0, dtype, skip).volume
    assert expected.any()
    for mm in (10.0, 1e-3):
        volume = mm * _answer(name, mm, dtype, skip).volume
        assert (volume - expected).abs().max() <= 1e-5 * expected.abs().max()
    assert torch.equal(2.0**-10 * _answer(name, 2.0**-10, dtype, skip).volume, expected)
