"""Conversion of the camera record to other conventions: K R t, 3x4 and 4x4 matrices, ASTRA, kornia;
and epipolar lines.

Pure functions of float64 tensors; lengths are mm and pixel centres are integers unless a Convention
states otherwise. A pinhole with its detector behind it equals a camera whose detector is mirrored
through the pinhole; for conventions without a detector it becomes an ordinary camera, rotated by
180 degrees about its axis.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras, Extent
from mvrecon.geometry.rigid import check_rotation, unit


class KRt(NamedTuple):
    """Intrinsics and pose of cameras, as in `to_krt`."""

    K: Float[Tensor, "m 3 3"]
    R: Float[Tensor, "m 3 3"]
    t: Float[Tensor, "m 3"]


class KorniaCameras(NamedTuple):
    """Arguments of kornia's `PinholeCamera`, in its order."""

    intrinsics: Float[Tensor, "m 4 4"]
    extrinsics: Float[Tensor, "m 4 4"]
    height: Float[Tensor, " m"]
    width: Float[Tensor, " m"]


def to_krt(cameras: Cameras) -> KRt:
    """Return K, R and t with pixels z (u, v, 1) = K (R X + t), z > 0 in mm on the object's side.

    Convention: OpenCV; K is upper triangular with positive focal lengths and K[2, 2] = 1, R is a
    rotation whose rows are the camera's axes right, down, forward. K contains a skew if u and v are
    not at right angles.

    Raises:
        ValueError: parallel beams, which have no source.
    """
    if cameras.parallel:
        raise ValueError("Parallel beams have no K, R, t; use to_frustum or to_astra")
    frame = cameras.frame * (-1 if cameras.extent == "behind" else 1)
    right = unit(frame[..., 0])
    forward = unit(torch.linalg.cross(frame[..., 0], frame[..., 1]))
    R = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-2)
    K = torch.linalg.inv((R @ frame).triu()) * cameras.distance[:, None, None]
    return KRt(K, R, -(R @ cameras.source[..., None])[..., 0])


def from_krt(
    K: Float[Tensor, "m 3 3"],
    R: Float[Tensor, "m 3 3"],
    t: Float[Tensor, "m 3"],
    shape: tuple[int, int],
    distance: float | Float[Tensor, " m"],
    extent: Extent = "ahead",
) -> Cameras:
    """Build the record from K, R and t, the inverse of `to_krt`.

    Args:
        K, R, t: as `to_krt` returns them.
        shape: detector pixels (rows, columns).
        distance: mm from the source or pinhole to the detector, fx times the pixel pitch. K, R, t
            do not determine it; for a vision camera it is arbitrary.
        extent: the valid range of a ray.

    Convention: OpenCV, as `to_krt`.

    Raises:
        ValueError: wrong shapes, values not finite, K without the last row (0, 0, 1), R not a
            rotation.
    """
    K, R, t = _checked("K", K, 3, 3), _checked("R", R, 3, 3), _checked("t", t, 3)
    if not torch.allclose(K[:, 2], K.new_tensor([0, 0, 1]).expand(len(K), 3)):
        raise ValueError(f"K must have the last row (0, 0, 1), got {K[:, 2].tolist()}")
    check_rotation(R)
    frame = R.mT @ torch.linalg.inv(K) * _distances(distance, K)
    source = -(R.mT @ t[..., None])[..., 0]
    return _from_frame(source, -frame if extent == "behind" else frame, shape, extent)


def from_matrix(
    P: Float[Tensor, "m 3 4"],
    shape: tuple[int, int],
    distance: float | Float[Tensor, " m"],
    extent: Extent = "segment",
) -> Cameras:
    """Build the record of central cameras from 3x4 matrices of any positive scale, the inverse of
    `Cameras.matrix`.

    Convention: P (X, 1) = w (u, v, 1) with w > 0 on the detector's side of the source, as
    `Cameras.matrix`. Negate P first if w < 0 there (RTK).

    Raises:
        ValueError: wrong shapes, values not finite, a singular left 3x3 (parallel beams), a
            distance not positive.
    """
    P = _checked("P", P, 3, 4)
    left = P[:, :, :3]
    if not (torch.linalg.det(unit(left)).abs() > 1e-12).all():
        raise ValueError(
            "P must have a left 3x3 that can be inverted; parallel beams have no source to find"
        )
    frame = torch.linalg.inv(left)
    source = -(frame @ P[:, :, 3:])[..., 0]
    # the frame's own distance: the last row of its inverse is n / distance
    unscaled = 1 / left[:, 2].norm(dim=-1)[:, None, None]
    return _from_frame(source, frame * _distances(distance, P) / unscaled, shape, extent)


def to_astra(cameras: Cameras) -> Float[Tensor, "m 12"]:
    """Return rows for ASTRA's "cone_vec" (or "parallel3d_vec"): source (or ray), detector centre,
    u, v.

    Convention: ASTRA's world is (x, y, z) in mm if its volume's window is given in mm; rays are not
    normalised.
    """
    centre = cameras.detector_centre
    first = cameras.origin - cameras.source if cameras.parallel else cameras.source
    return torch.cat([first, centre, cameras.u, cameras.v], dim=-1)


def from_astra(
    vectors: Float[Tensor, "m 12"],
    shape: tuple[int, int],
    parallel: bool = False,
    extent: Extent | None = None,
    flip_rows: bool = False,
) -> Cameras:
    """Build the record from ASTRA's "cone_vec" rows, or with `parallel` from "parallel3d_vec" rows.

    Args:
        vectors: rows as from `to_astra`.
        shape: detector pixels (rows, columns).
        parallel: the first three numbers are a ray's direction, with the record's depth as length.
        extent: which part of a ray counts; by default "segment", and "line" for parallel beams.
        flip_rows: reverse the detector's rows; the views' rows must be reversed with them.

    Convention: ASTRA's own circular geometries have v upwards: cone beams are left-handed here and
    need `flip_rows`. Its parallel rays run from the detector to the source of its cone beams, and a
    whole line has no direction: they get the one by which the camera is right-handed.

    Raises:
        ValueError: wrong shapes, values not finite, left-handed cameras.
    """
    first, centre, u, v = _checked("ASTRA vectors", vectors, 12).split(3, dim=-1)
    extent = extent or ("line" if parallel else "segment")
    v = -v if flip_rows else v
    if parallel and extent == "line":
        turned = torch.linalg.det(torch.stack([u, v, first], dim=-1)) < 0
        first = torch.where(turned[:, None], -first, first)
    origin = centre - u * (shape[1] - 1) / 2 - v * (shape[0] - 1) / 2
    source = origin - first if parallel else first
    return Cameras(source, origin, u, v, shape, parallel, extent)


def to_kornia(cameras: Cameras) -> KorniaCameras:
    """Return intrinsics, extrinsics, height and width for kornia's `PinholeCamera`.

    Convention: kornia's, which is OpenCV's: extrinsics map the world to the camera, pixel centres
    are integers.

    Raises:
        ValueError: parallel beams.
    """
    K, R, t = to_krt(cameras)
    intrinsics = torch.eye(4).to(K).repeat(len(K), 1, 1)
    extrinsics = intrinsics.clone()
    intrinsics[:, :3, :3] = K
    extrinsics[:, :3, :3], extrinsics[:, :3, 3] = R, t
    height, width = (K.new_full((len(K),), n) for n in cameras.shape)
    return KorniaCameras(intrinsics, extrinsics, height, width)


def from_kornia(
    intrinsics: Float[Tensor, "m 4 4"],
    extrinsics: Float[Tensor, "m 4 4"],
    shape: tuple[int, int],
    distance: float | Float[Tensor, " m"],
    extent: Extent = "ahead",
) -> Cameras:
    """Build the record from kornia's cameras, the inverse of `to_kornia`; arguments and errors as
    `from_krt`.

    Raises:
        ValueError: intrinsics with a translation in the fourth column, which kornia would apply.
    """
    K, E = _checked("intrinsics", intrinsics, 4, 4), _checked("extrinsics", extrinsics, 4, 4)
    if K[:, :3, 3].any():
        raise ValueError(
            f"Intrinsics must have zeros in the fourth column, got {K[:, :3, 3].tolist()}"
        )
    return from_krt(K[:, :3, :3], E[:, :3, :3], E[:, :3, 3], shape, distance, extent)


def _from_frame(
    source: Float[Tensor, "m 3"],
    frame: Float[Tensor, "m 3 3"],
    shape: tuple[int, int],
    extent: Extent,
) -> Cameras:
    u, v, ray = frame.unbind(dim=-1)
    return Cameras(source, source + ray, u, v, shape, extent=extent)


def _distances(distance: float | Tensor, like: Tensor) -> Float[Tensor, "m 1 1"]:
    distances = torch.as_tensor(distance).to(like).expand(len(like))
    if not ((distances > 0) & distances.isfinite()).all():
        raise ValueError(
            f"The distance from source to detector must be positive mm, got {distance}"
        )
    return distances[:, None, None]


def _checked(name: str, values: Tensor, *shape: int) -> Tensor:
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if tensor.ndim != len(shape) + 1 or tensor.shape[1:] != shape:
        raise ValueError(
            f"{name} must be [m {' '.join(map(str, shape))}], got {list(tensor.shape)}"
        )
    if not tensor.isfinite().all():
        raise ValueError(f"{name} must be finite, got {tensor.tolist()}")
    return tensor


def epipolar_line(
    cameras: Cameras, first: int, second: int, pixels: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 3"]:
    """Return the epipolar lines in camera `second` of pixels of camera `first`: (a, b, c) with a u
    + b v + c = 0 and a^2 + b^2 = 1, so that c is in pixels.

    All points on the ray of a pixel project onto its line (Hartley and Zisserman, Multiple View
    Geometry, 2004, section 9.2). Computed by kornia from the 3x4 matrices, normalised to the
    detectors' centres and widths for precision.

    Args:
        cameras: the rig, central or parallel.
        first: index of the pixels' camera.
        second: index of the lines' camera.
        pixels: (u, v), integer at pixel centres.

    Returns:
        The line (a, b, c) of each pixel.

    Raises:
        ValueError: equal cameras, or two at one position, which have no epipolar lines.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [32, 32], "pixel_mm": 2.0})
        >>> uvz = rig.project(torch.tensor([[10.0, 20.0, 5.0]]))  # images of a point in all cameras
        >>> a, b, c = mv.epipolar_line(rig, 0, 1, uvz[0, :, :2])[0]
        >>> bool((a * uvz[1, 0, 0] + b * uvz[1, 0, 1] + c).abs() < 1e-3)  # pixels from the line
        True
    """
    # slow to import
    from kornia.geometry.epipolar import compute_correspond_epilines, fundamental_from_projections

    rows, columns = cameras.shape
    # normalise (u, v, 1) to within about one of the detector's centre for kornia
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
