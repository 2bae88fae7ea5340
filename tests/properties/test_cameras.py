"""Camera records: pixels to rays to points and back, and every other description to the record and
back.
"""

import torch
from hypothesis import given, strategies as st
from torch import Tensor

from mvrecon.geometry.cameras import convert, files
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import pixel_centres
from tests.properties.strategies import CUBE, ROTATIONS, SEEDS, cases, radius, vectors

EPS = torch.finfo(torch.float64).eps
ANY = {"case": cases()}
CENTRAL = {"case": cases(parallel=False)}


def some_pixels(cameras: Cameras, seed: int, count: int = 20) -> Tensor:
    """Pixel coordinates and depths on the side of each camera that counts, [m n 3]."""
    least, most = (max(min(w, 3.0), -3.0) for w in cameras.ray_extent)
    t = torch.rand(
        len(cameras), count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    uv = t[..., :2] * t.new_tensor(cameras.shape[::-1]) - 0.5
    w = least + (most - least) * (0.05 + 0.9 * t[..., 2:])
    w = torch.where(w.abs() < 0.01, 0.01, w)  # at the source itself there is no pixel
    return torch.cat([uv, w * cameras.distance[:, None, None]], dim=-1)


def missed(cameras: Cameras, xyz: Tensor, uvz: Tensor) -> Tensor:
    """What rounding may do to (u, v, z): |M^-1| (|M| |q| + |X| + |S|), as of a linear system
    (Skeel, 1979).
    """
    inverse = torch.linalg.inv(cameras.frame).abs()
    w = uvz[..., 2:] / cameras.distance[:, None, None]
    under = torch.ones_like(w) if cameras.parallel else w
    q = torch.cat([uvz[..., :2] * under, w], dim=-1).abs()
    size = q @ cameras.frame.abs().mT + xyz.abs() + cameras.source[:, None].abs()
    change = (
        16
        * EPS
        * (size + q @ (cameras.frame.abs() @ inverse @ cameras.frame.abs()).mT)
        @ inverse.mT
    )
    uv = (
        change[..., :2] + (0 if cameras.parallel else uvz[..., :2].abs() * change[..., 2:])
    ) / under.abs()
    return torch.cat([uv, change[..., 2:] * cameras.distance[:, None, None]], dim=-1)


@given(**ANY, seed=SEEDS)
def test_pixels_to_points_to_pixels(case, seed):
    """P1, and every pixel's ray runs through the points that have its coordinates."""
    cameras, uvz = case.rays, some_pixels(case.rays, seed)
    xyz = cameras.unproject(uvz)
    seen = torch.stack(
        [camera.project(points)[0] for camera, points in zip(cameras, xyz, strict=True)]
    )
    assert ((seen - uvz).abs() <= missed(cameras, xyz, uvz)).all()
    start, end = cameras.rays()
    pixels = pixel_centres(cameras.shape).flatten(0, 1).expand(len(cameras), -1, -1)
    for w in (-1.0, 0.3, 1.0, 2.5):
        points = (start + w * (end - start)).flatten(1, 2)
        place = torch.cat(
            [pixels, w * cameras.distance[:, None, None].expand(-1, pixels.shape[1], 1)], dim=-1
        )
        seen = torch.stack(
            [camera.project(each)[0] for camera, each in zip(cameras, points, strict=True)]
        )
        assert ((seen - place).abs() <= missed(cameras, points, place)).all()


def check_same(
    one: Cameras, other: Cameras, moved: Tensor | float = 0.0, condition: Tensor | None = None
) -> None:
    """The same record, each vector to what rounding does to it.

    Args:
        one, other: the records.
        moved: mm by which the cameras were moved in between.
        condition: of the matrix that was inverted; by default that of the frame's angles, whatever
            its lengths.
    """
    assert (one.shape, one.parallel, one.extent) == (other.shape, other.parallel, other.extent)
    frame = torch.nn.functional.normalize(other.frame, dim=-2)
    bound = 64 * EPS * (torch.linalg.cond(frame) ** 2 if condition is None else condition)[:, None]
    sizes = {name: getattr(other, name).norm(dim=-1, keepdim=True) for name in VECTORS}
    place = sum(sizes.values()) + moved
    for name in VECTORS:
        scale = place if name in ("source", "origin") else sizes[name]
        assert ((getattr(one, name) - getattr(other, name)).abs() <= bound * scale).all(), name


@given(**CENTRAL, scale=st.floats(1e-3, 1e3))
def test_other_descriptions_of_central_cameras_round_trip(case, scale):
    """P2: K R t, 3x4 matrices of any scale, kornia's."""
    cameras = case.rays
    shape, distance, extent = cameras.shape, cameras.distance, cameras.extent
    K, R, t = convert.to_krt(cameras)
    check_same(convert.from_krt(K, R, t, shape, distance, extent), cameras)
    # elimination does not see that rows differ in length: a far source costs the pixels' steps
    # digits
    condition = torch.linalg.cond(cameras.frame)
    check_same(
        convert.from_matrix(scale * cameras.matrix, shape, distance, extent),
        cameras,
        condition=condition,
    )
    intrinsics, extrinsics, height, width = convert.to_kornia(cameras)
    assert (height == shape[0]).all() and (width == shape[1]).all()
    check_same(convert.from_kornia(intrinsics, extrinsics, shape, distance, extent), cameras)


@given(**ANY, factor=st.integers(1, 4), R=ROTATIONS, turn=CUBE, shift=vectors(-10, 10))
def test_camera_transformations_are_invertible(case, factor, R, turn, shift):
    """ASTRA's vectors of any rig, pixels cut and joined, a motion and its inverse."""
    cameras, t = case.rays, shift * radius(case.grid)
    parallel, extent = cameras.parallel, cameras.extent
    check_same(
        convert.from_astra(convert.to_astra(cameras), cameras.shape, parallel, extent), cameras
    )
    check_same(cameras.refined(factor).binned(factor), cameras)
    there = cameras.moved(turn, 0 * t)
    for name in VECTORS:  # the axes' rotations round nothing
        assert torch.equal(getattr(there.moved(turn.T, 0 * t), name), getattr(cameras, name))
    check_same(cameras.moved(R, t).moved(R.T, -R.T @ t), cameras, t.norm())


@given(**ANY)
def test_a_rig_round_trips_through_a_file_exactly(case, tmp_path_factory):
    """P15: the same numbers, and the same bytes when they are saved again."""
    folder = tmp_path_factory.mktemp("rig")
    files.save(case.rays, folder / "one.json")
    cameras = files.from_file(folder / "one.json")
    files.save(cameras, folder / "two.json")
    assert (folder / "one.json").read_bytes() == (folder / "two.json").read_bytes()
    assert all(torch.equal(getattr(cameras, name), getattr(case.rays, name)) for name in VECTORS)
    found, expected = ((each.shape, each.parallel, each.extent) for each in (cameras, case.rays))
    assert found == expected
