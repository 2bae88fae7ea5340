"""One rig of every kind, and camera records at random."""

from typing import Any

import torch

from mvrecon.geometry.cameras.camera import Cameras, Extent
from mvrecon.geometry.rigid import random_rotation

DETECTOR = {"pixels": [6, 9], "pixel_mm": [2.0, 3.0]}
OFFSET = {**DETECTOR, "offset_mm": [5.0, -7.0]}

#: Options of each built-in camera but `from_file`; the detectors are oblong, so that a swap of axes
#: shows.
OPTIONS: dict[str, dict[str, Any]] = {
    "circular": {"n_views": 5, "sid": 400.0, "sdd": 800.0, "detector": OFFSET},
    "arc": {"n_views": 4, "sid": 400.0, "sdd": 700.0, "detector": OFFSET, "arc_degrees": 120.0},
    "dome": {
        "n_views": 7,
        "radius": 200.0,
        "focal": 70.0,
        "aperture_degrees": 180.0,
        "detector": OFFSET,
    },
    "parallel": {"n_views": 5, "detector": OFFSET, "depth_mm": 300.0},
    "random": {
        "n_views": (4, 6),
        "sid": (300.0, 500.0),
        "magnification": (1.3, 2.0),
        "pixels": (5, 9),
        "field_mm": (60.0, 90.0),
    },
    "dcspect80": {"pixels": [6, 9]},
}


def random_cameras(
    count: int = 5, seed: int = 0, extent: Extent = "segment", skew: float = 0.1
) -> Cameras:
    """Central cameras in any pose, with oblong pixels, offset detectors, and rows not square to
    columns.
    """
    rng = torch.Generator().manual_seed(seed)
    axes = random_rotation(rng, count)
    right, down, forward = axes.unbind(dim=-1)
    side = -1 if extent == "behind" else 1
    u = 1.5 * right
    v = 0.8 * down + skew * right
    offset = 3 * torch.randn(count, 2, generator=rng, dtype=torch.float64)
    origin = side * 90 * forward + offset[:, :1] * right + offset[:, 1:] * down - 4 * u - 3 * v
    source = 50 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return Cameras(source, source + origin, u, v, (7, 9), extent=extent)


def same(a: Cameras, b: Cameras, tolerance: float = 1e-10) -> bool:
    """Whether two records hold the same numbers."""
    vectors = all(
        torch.allclose(getattr(a, name), getattr(b, name), rtol=tolerance, atol=tolerance)
        for name in ("source", "origin", "u", "v")
    )
    return vectors and (a.shape, a.parallel, a.extent) == (b.shape, b.parallel, b.extent)
