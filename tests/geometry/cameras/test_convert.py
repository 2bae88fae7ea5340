import math

import pytest
import torch

from mvrecon.geometry import lattice
from mvrecon.geometry.cameras import convert
from mvrecon.geometry.cameras.camera import EXTENTS
from mvrecon.geometry.cameras.rigs import circular, parallel
from tests.geometry.cameras.rigs import DETECTOR, OPTIONS, random_cameras, same

CENTRAL = pytest.mark.parametrize("extent", EXTENTS)


def points(cameras, count=12, seed=3):
    """World points on the side of each camera that counts, [m n 3], and their pixel coordinates and
    depths.
    """
    rng = torch.Generator().manual_seed(seed)
    uv = 9 * torch.rand(len(cameras), count, 2, generator=rng, dtype=torch.float64)
    z = 20 + 60 * torch.rand(len(cameras), count, 1, generator=rng, dtype=torch.float64)
    uvz = torch.cat([uv, -z if cameras.extent == "behind" else z], dim=-1)
    return cameras.unproject(uvz), uvz


def close(actual, expected, tolerance=1e-10):
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@CENTRAL
def test_krt_round_trip(extent):
    cameras = random_cameras(extent=extent)
    K, R, t = convert.to_krt(cameras)
    assert same(convert.from_krt(K, R, t, cameras.shape, cameras.distance, extent), cameras)


@CENTRAL
def test_krt_projects_as_the_record_does_with_objects_in_front(extent):
    cameras = random_cameras(extent=extent)
    K, R, t = convert.to_krt(cameras)
    xyz, uvz = points(cameras)
    projected = (xyz @ R.mT + t[:, None]) @ K.mT
    close(projected[..., :2] / projected[..., 2:], uvz[..., :2])
    close(projected[..., 2], uvz[..., 2].abs())


@CENTRAL
def test_krt_follows_opencv(extent):
    K, R, _ = convert.to_krt(random_cameras(extent=extent))
    close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
    assert (torch.linalg.det(R) > 0).all() and torch.equal(K, K.triu())
    assert (K.diagonal(dim1=1, dim2=2) > 0).all()
    close(K[:, 2, 2], torch.ones(5, dtype=torch.float64))


def test_krt_of_a_cone_beam_is_known():
    K, R, t = convert.to_krt(circular(1, 400.0, 800.0, DETECTOR))
    close(K[0], torch.tensor([[800 / 3, 0, 4], [0, 800 / 2, 2.5], [0, 0, 1]], dtype=torch.float64))
    close(R[0], torch.tensor([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]], dtype=torch.float64))
    close(t[0], torch.tensor([0.0, 0, 400], dtype=torch.float64))


@CENTRAL
def test_matrix_round_trip_at_any_positive_scale(extent):
    cameras = random_cameras(extent=extent)
    scale = torch.tensor([1e-3, 1.0, 7.0, 250.0, 1e4], dtype=torch.float64)[:, None, None]
    assert same(
        convert.from_matrix(scale * cameras.matrix, cameras.shape, cameras.distance, extent),
        cameras,
        1e-9,
    )
    with pytest.raises(ValueError, match="left-handed"):
        convert.from_matrix(-cameras.matrix, cameras.shape, cameras.distance, extent)


@CENTRAL
def test_frustum_coordinates_are_pixels_and_f_over_z(extent):
    cameras = random_cameras(extent=extent)
    xyz, uvz = points(cameras)
    H = lattice.to_frustum(cameras, f=250.0)
    h = torch.cat([xyz, torch.ones_like(xyz[..., :1])], dim=-1) @ H.mT
    close(h[..., :2] / h[..., 3:], uvz[..., :2])
    close(h[..., 2] / h[..., 3], 250 / uvz[..., 2])
    close(h[..., 3], uvz[..., 2])


def test_frustum_coordinates_of_parallel_beams_are_pixels_and_depth():
    cameras = parallel(**OPTIONS["parallel"])
    xyz, uvz = points(cameras)
    h = torch.cat([xyz, torch.ones_like(xyz[..., :1])], dim=-1) @ lattice.to_frustum(cameras).mT
    close(h, torch.cat([uvz, torch.ones_like(uvz[..., :1])], dim=-1))


@CENTRAL
def test_astra_round_trip(extent):
    cameras = random_cameras(extent=extent)
    assert same(
        convert.from_astra(convert.to_astra(cameras), cameras.shape, extent=extent), cameras
    )


def test_astra_parallel_round_trip():
    cameras = parallel(**OPTIONS["parallel"])
    rows = convert.to_astra(cameras)
    assert same(convert.from_astra(rows, cameras.shape, parallel=True, extent="segment"), cameras)
    assert convert.from_astra(rows, cameras.shape, parallel=True).extent == "line"


def astra_circular(angle, sid, odd, du, dv):
    """A row of ASTRA's circular cone geometry as its manual writes it, v upwards."""
    c, s = math.cos(angle), math.sin(angle)
    return [s * sid, -c * sid, 0, -s * odd, c * odd, 0, c * du, s * du, 0, 0, 0, dv]


def test_the_circle_of_astra_is_ours_with_rows_reversed():
    angles = [0.0, 30.0, 200.0]
    rows = torch.tensor(
        [astra_circular(math.radians(a), 400, 400, 3, 2) for a in angles], dtype=torch.float64
    )
    with pytest.raises(ValueError, match="left-handed"):
        convert.from_astra(rows, (6, 9))
    ours = circular(3, 400.0, 800.0, DETECTOR, angles=[a - 90 for a in angles])
    assert same(convert.from_astra(rows, (6, 9), flip_rows=True), ours)


@pytest.mark.parametrize("flip_rows", [False, True])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, -1, -1), (1, -1, 1)])
def test_parallel_lines_of_astra_have_no_direction(signs, flip_rows):
    """ASTRA's parallel3d geometry has rays (sin a, -cos a), against those of its cone beams: pixel
    (i, j) measures the line through centre + u (j - 4) + v (i - 2.5), whichever way it runs.
    """
    angles = torch.deg2rad(torch.tensor([0.0, 30.0, 200.0], dtype=torch.float64))
    c, s, zero = angles.cos(), angles.sin(), torch.zeros(3, dtype=torch.float64)
    ray, u = torch.stack([s, -c, zero], dim=1), torch.stack([3 * c, 3 * s, zero], dim=1)
    v = torch.tensor([[0, 0, 2.0]], dtype=torch.float64).repeat(3, 1)
    signed = ray * torch.tensor(signs, dtype=torch.float64)[:, None]
    rows = torch.cat([signed, 0 * u, u, v], dim=1)
    rig = convert.from_astra(rows, (6, 9), parallel=True, flip_rows=flip_rows)
    i, j = (4, 1)
    point = u * (j - 4) + v * (i - 2.5)
    uv = rig.project(point + 50 * ray)[torch.arange(3), torch.arange(3), :2]
    expected = torch.tensor([j, 5 - i if flip_rows else i], dtype=torch.float64)
    assert torch.allclose(uv, expected.expand(3, 2), atol=1e-9)


@pytest.mark.parametrize("extent", ["ahead", "behind"])
def test_kornia_projects_and_unprojects_as_the_record_does(extent):
    from kornia.geometry.camera import PinholeCamera, project_points

    cameras = random_cameras(extent=extent, skew=0.0)
    intrinsics, extrinsics, height, width = convert.to_kornia(cameras)
    xyz, uvz = points(cameras)
    kornia = PinholeCamera(intrinsics, extrinsics, height, width)
    close(kornia.project(xyz), uvz[..., :2])
    for m in range(len(cameras)):  # kornia takes one depth tensor a camera
        one = PinholeCamera(
            intrinsics[m : m + 1], extrinsics[m : m + 1], height[m : m + 1], width[m : m + 1]
        )
        close(one.unproject(uvz[m, :, :2], uvz[m, :, 2:].abs()), xyz[m], 1e-9)
    own = xyz @ extrinsics[:, :3, :3].mT + extrinsics[:, None, :3, 3]
    close(
        project_points(own, intrinsics[:, None, :3, :3].expand(-1, xyz.shape[1], -1, -1)),
        uvz[..., :2],
    )


@CENTRAL
def test_kornia_round_trip(extent):
    cameras = random_cameras(extent=extent)
    intrinsics, extrinsics, height, width = convert.to_kornia(cameras)
    assert (height == 7).all() and (width == 9).all()
    assert same(
        convert.from_kornia(intrinsics, extrinsics, (7, 9), cameras.distance, extent), cameras
    )


@pytest.mark.parametrize("to", [convert.to_krt, convert.to_kornia])
def test_parallel_beams_have_no_central_description(to):
    with pytest.raises(ValueError, match="Parallel beams have no K, R, t"):
        to(parallel(2, DETECTOR))


def test_invalid_descriptions_are_refused():
    cameras = random_cameras()
    K, R, t = convert.to_krt(cameras)
    with pytest.raises(ValueError, match=r"K must be \[m 3 3\], got \[3, 3\]"):
        convert.from_krt(K[0], R, t, (7, 9), 90.0)
    with pytest.raises(ValueError, match="R must be finite"):
        convert.from_krt(K, R * math.nan, t, (7, 9), 90.0)
    with pytest.raises(ValueError, match="R must be rotations"):
        convert.from_krt(K, 2 * R, t, (7, 9), 90.0)
    with pytest.raises(ValueError, match="last row"):
        convert.from_krt(2 * K, R, t, (7, 9), 90.0)
    for distance in (0.0, math.nan):
        with pytest.raises(ValueError, match="must be positive mm"):
            convert.from_krt(K, R, t, (7, 9), distance)
    with pytest.raises(ValueError, match="left 3x3 that can be inverted"):
        convert.from_matrix(parallel(2, DETECTOR).matrix, (6, 9), 90.0)
    with pytest.raises(ValueError, match=r"ASTRA vectors must be \[m 12\], got \[5, 3\]"):
        convert.from_astra(t, (7, 9))
    intrinsics, extrinsics, *_ = convert.to_kornia(cameras)
    intrinsics[:, 0, 3] = 1
    with pytest.raises(ValueError, match="zeros in the fourth column"):
        convert.from_kornia(intrinsics, extrinsics, (7, 9), 90.0)
