"""Blur: its own adjoint, and a mean."""

import torch

from mvrecon.methods.calibration.alignment import Blur, blurred
from mvrecon.testing import adjoint_gap


def test_a_blur_is_symmetric_keeps_sums_and_has_its_width():
    rng = torch.Generator().manual_seed(0)
    blur = Blur((5, 21, 31), (0.0, 1.5, 2.0))
    x, y = (torch.randn(1, 1, 5, 21, 31, dtype=torch.float64, generator=rng) for _ in range(2))
    assert adjoint_gap(blur, x, y) < 1e-12
    point = torch.zeros(1, 1, 5, 21, 31, dtype=torch.float64)
    point[..., 2, 10, 15] = 1.0
    image = blur(point)[0, 0]
    assert abs(image.sum() - 1) < 1e-9 and abs(image[2].sum() - 1) < 1e-9
    place = torch.arange(31, dtype=torch.float64) - 15
    assert abs((image.sum(dim=(0, 1)) * place**2).sum() - 4.0) < 1e-3


def test_a_constant_view_remains_constant_for_any_dead_pixels():
    mask = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0)) > 0.3
    views = torch.where(mask, 2.0, torch.nan)[None, None]
    assert torch.allclose(blurred(views, 1.5, mask), torch.tensor(2.0))
