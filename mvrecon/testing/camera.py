"""Contract check of cameras."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import pixel_centres


def check_camera(name: str, **options: Any) -> None:
    """Raise AssertionError unless the named camera, built with these options, satisfies its
    contract.

    Repeatable; right-handed when looking at the object; pixel centres project to themselves; depth
    grows along every ray; project inverts unproject to 1e-9; a rig of M cameras equals M rigs of
    one.
    """
    cameras, again = CAMERAS.build(name, **options), CAMERAS.build(name, **options)
    assert isinstance(cameras, Cameras), f"expected Cameras, got {type(cameras).__name__}"
    for vector in VECTORS:
        assert torch.equal(getattr(cameras, vector), getattr(again, vector)), (
            f"{vector} differs from call to call"
        )
    _check_handedness(cameras)
    _check_pixels(cameras)
    uvz = _somewhere(cameras)
    xyz = cameras.unproject(uvz)
    for m, camera in enumerate(cameras):
        uv = camera.project(xyz[m])[0]
        error = ((uv - uvz[m]).abs() / (1 + uvz[m].abs())).max()
        assert error < 1e-9, (
            f"camera {m}: projecting a point that was unprojected misses by {error:.2g}"
        )
        assert torch.allclose(cameras.project(xyz[m])[m], uv, rtol=1e-12, atol=1e-9), (
            f"camera {m} differs when alone"
        )


def _check_handedness(cameras: Cameras) -> None:
    ahead = (
        cameras.source - cameras.origin
        if cameras.extent == "behind"
        else cameras.origin - cameras.source
    )
    handed = (torch.linalg.cross(cameras.u, cameras.v) * ahead).sum(-1)
    assert (handed > 0).all(), f"left-handed cameras: {(handed <= 0).nonzero().flatten().tolist()}"


def _check_pixels(cameras: Cameras) -> None:
    start, end = cameras.rays()
    pixels, depths = pixel_centres(cameras.shape), []
    for m, camera in enumerate(cameras):
        for w in (-2.0, -0.5, 0.5, 1.0, 2.0):
            uvz = camera.project(start[m] + w * (end - start)[m])[0]
            error = (uvz[..., :2] - pixels).abs().max()
            assert error < 1e-9 * max(cameras.shape), (
                f"camera {m}: pixel centres at w = {w} are missed by {error:.2g} px"
            )
            depths.append(uvz[..., 2])
    rising = torch.stack(depths).unflatten(0, (len(cameras), -1)).diff(dim=1) > 0
    assert rising.all(), "depth does not grow along the rays"


def _somewhere(cameras: Cameras, count: int = 50) -> Float[Tensor, "m n 3"]:
    """Random pixel coordinates and depths on the valid side of each camera."""
    nearest, farthest = (max(min(w, 3.0), -3.0) for w in cameras.ray_extent)
    t = torch.rand(
        len(cameras), count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    uv = t[..., :2] * t.new_tensor(cameras.shape[::-1]) - 0.5
    w = nearest + (farthest - nearest) * (0.05 + 0.9 * t[..., 2:])
    return torch.cat([uv, w * cameras.distance[:, None, None]], dim=-1)
