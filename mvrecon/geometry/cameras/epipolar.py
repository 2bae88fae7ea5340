"""Where what one camera sees at a pixel can be in another camera: the epipolar line."""

import torch
from jaxtyping import Float
from kornia.geometry.epipolar import compute_correspond_epilines, fundamental_from_projections
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras


def epipolar_line(
    cameras: Cameras, first: int, second: int, pixels: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 3"]:
    """The epipolar lines in camera `second` of pixels of camera `first`: (a, b, c), all points
    (u, v) with a u + b v + c = 0, of which a^2 + b^2 = 1, so that c is in pixels.

    Everything on the ray of such a pixel is seen on its line, whatever its depth (Hartley and
    Zisserman, Multiple View Geometry, 2004, section 9.2). By kornia, from the 3x4 matrices, about
    the detectors' centres and in detector widths, so that no digits are lost.

    Args:
        cameras: the rig, central or parallel.
        first: index of the camera that the pixels are of.
        second: index of the camera that the lines are in.
        pixels: (u, v), integer at pixel centres.

    Raises:
        ValueError: one camera twice, or two at one place, which have no such lines.
    """
    rows, columns = cameras.shape
    # (u, v, 1) to coordinates within about one of the detector's centre, in which kornia computes
    centred = torch.tensor(
        [[1 / columns, 0, -0.5], [0, 1 / rows, -0.5], [0, 0, 1]], dtype=torch.float64
    )
    P = centred @ cameras.matrix[[first, second]].detach().cpu().double()
    centre = cameras.origin.detach().cpu().double().mean(dim=0)
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] *= cameras.distance.detach().cpu().double().mean()
    world[:3, 3] = centre
    P = P @ world
    P = P / P.norm(dim=(1, 2), keepdim=True)
    F = fundamental_from_projections(P[:1], P[1:])
    if not F.isfinite().all() or F.norm() < 1e-9:
        raise ValueError(f"Cameras {first} and {second} are at one place: no epipolar lines")
    points = pixels.detach().cpu().double() @ centred[:2, :2].T + centred[:2, 2]
    lines = compute_correspond_epilines(points[None], F)[0] @ centred
    return lines / lines[:, :2].norm(dim=1, keepdim=True)
