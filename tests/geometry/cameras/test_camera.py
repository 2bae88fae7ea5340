import math

import pytest
import torch

from mvrecon.geometry.cameras.camera import EXTENTS, VECTORS, Cameras
from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.geometry.rigid import random_rotation
from mvrecon.testing import gradient_gap
from tests.geometry.cameras.rigs import random_cameras, same


def record(**changes):
    """Three cameras at (0, 0, -100) looking along +z, which are right-handed as OpenCV's."""
    vectors = {
        "source": [0.0, 0, -100],
        "origin": [-4.0, -3, 100],
        "u": [2.0, 0, 0],
        "v": [0.0, 2, 0],
    }
    options = {name: torch.tensor([vector] * 3) for name, vector in vectors.items()}
    return Cameras(**(options | {"shape": (4, 5)} | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u": torch.tensor([2.0, 0, 0])}, r"u as \[3 3\], one row per camera, got \[3\]"),
        ({"source": torch.zeros(3)}, r"source as \[m 3\].* got \[3\]"),
        ({"source": torch.zeros(0, 3)}, r"source as \[0 3\].* got \[0, 3\]"),
        ({"v": torch.tensor([[0.0, 2, 0]])}, r"v as \[3 3\].* got \[1, 3\]"),
        ({"v": torch.zeros(2, 3)}, r"v as \[3 3\].* got \[2, 3\]"),
        ({"origin": torch.zeros(3, 2)}, r"origin as \[3 3\].* got \[3, 2\]"),
        ({"origin": torch.full((3, 3), math.nan)}, "finite mm, got origin = .*nan"),
        ({"source": torch.full((3, 3), math.inf)}, "finite mm, got source = .*inf"),
        ({"shape": (4, 0)}, r"positive integers, got \(4, 0\)"),
        ({"shape": (4, 5, 6)}, r"\(rows, columns\).* got \(4, 5, 6\)"),
        ({"shape": (4.5, 5)}, r"positive integers, got \(4.5, 5\)"),
        ({"extent": "segments"}, "Unknown extent 'segments'. Known: segment, behind, ahead, line"),
        ({"u": torch.tensor([[-2.0, 0, 0]] * 3)}, "right-handed .* camera 0 is left-handed"),
        ({"extent": "behind"}, "right-handed .* camera 0 is left-handed"),
        ({"u": torch.tensor([[2.0, 0, 0]] * 2 + [[-2.0, 0, 0]])}, "camera 2 is left-handed"),
        ({"v": torch.tensor([[2.0, 0, 0]] * 3)}, "must not be flat, .* camera 0"),
        ({"u": torch.zeros(3, 3)}, "must not be flat"),
        (
            {"origin": torch.tensor([[-4.0, -3, 100]] * 2 + [[-4.0, -3, -100]])},
            "must not be flat, .* camera 2",
        ),
    ],
)
def test_bad_records_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        record(**changes)


def test_cameras_on_different_devices_are_refused():
    with pytest.raises(ValueError, match="one device, got v on meta, source on cpu"):
        record(v=torch.zeros(3, 3, device="meta"))


def test_numbers_keep_their_precision_in_any_container():
    third = 1 / 3
    lists = Cameras([[0, 0, -third]], [[0, 0, 1]], [[1, 0, 0]], [[0, 1, 0]], (1, 1))  # type: ignore[arg-type]
    assert lists.source.dtype == torch.float64 and lists.source[0, 2].item() == -third


@pytest.mark.parametrize("convert", [lambda x: x, torch.Tensor.numpy])
def test_a_rig_copies_its_input_but_follows_optimised_tensors(convert):
    vectors = [getattr(record(), name).clone() for name in VECTORS]
    cameras = Cameras(*map(convert, vectors), (4, 5))
    before = [getattr(cameras, name).clone() for name in VECTORS]
    for vector in vectors:
        vector *= 2
    assert all(torch.equal(getattr(cameras, n), x) for n, x in zip(VECTORS, before, strict=True))
    source = before[0].requires_grad_()
    cameras = Cameras(source, *before[1:], (4, 5))
    with torch.no_grad():
        source += 1
    assert torch.equal(cameras.source, source)


def test_the_textbook_camera():
    """At depth 150 of 200, the centre of pixel (u, v) = (4, 0) of a 4 x 5 detector: (4, -3) mm
    times 150/200.
    """
    cameras = record()
    assert torch.equal(cameras.distance, torch.full((3,), 200.0, dtype=torch.float64))
    xyz = torch.tensor([4.0 * 0.75, -3.0 * 0.75, 50.0], dtype=torch.float64)
    uvz = torch.tensor([4.0, 0.0, 150.0], dtype=torch.float64).expand(3, 3)
    torch.testing.assert_close(cameras.project(xyz), uvz, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(cameras.unproject(uvz), xyz.expand(3, 3), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("extent", EXTENTS)
def test_the_matrix_agrees_with_project(extent):
    cameras = random_cameras(extent=extent)
    xyz = 40 * torch.randn(11, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ones = torch.ones(11, 1, dtype=torch.float64)
    homogeneous = torch.cat([xyz, ones], dim=-1) @ cameras.matrix.mT
    uvz = cameras.project(xyz)
    torch.testing.assert_close(
        homogeneous[..., :2] / homogeneous[..., 2:], uvz[..., :2], rtol=1e-10, atol=1e-10
    )
    torch.testing.assert_close(
        homogeneous[..., 2] * cameras.distance[:, None], uvz[..., 2], rtol=1e-10, atol=1e-10
    )


def test_a_detector_mirrored_through_its_pinhole_measures_the_same():
    behind = random_cameras(extent="behind")
    ahead = Cameras(
        behind.source,
        2 * behind.source - behind.origin,
        -behind.u,
        -behind.v,
        behind.shape,
        False,
        "ahead",
    )
    xyz = 40 * torch.randn(11, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    a, b = ahead.project(xyz), behind.project(xyz)
    torch.testing.assert_close(a[..., :2], b[..., :2], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(a[..., 2], -b[..., 2], rtol=1e-9, atol=1e-9)


def test_points_keep_their_shape_and_dtype():
    cameras = random_cameras(3)
    assert cameras.project(torch.rand(3)).shape == (3, 3)
    assert cameras.project(torch.rand(2, 4, 5, 3)).shape == (3, 2, 4, 5, 3)
    assert cameras.project(torch.rand(2, 3)).dtype == torch.float32
    assert cameras.unproject(torch.rand(3, 2, 4, 3)).shape == (3, 2, 4, 3)


def test_projection_is_differentiable_in_points_and_pose():
    cameras = random_cameras(2)
    vectors = [getattr(cameras, name).clone().requires_grad_() for name in VECTORS]
    xyz = torch.randn(
        3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    ).requires_grad_()

    def project(xyz, *vectors):
        return Cameras(*vectors, shape=cameras.shape).project(xyz)

    assert gradient_gap(project, xyz, *vectors) < 1e-6


def test_cameras_can_be_indexed():
    cameras = random_cameras(5)
    for index in (
        2,
        -3,
        [2],
        torch.tensor([2]),
        slice(2, 3),
        torch.arange(5) == 2,
        torch.tensor(2),
    ):
        one = cameras[index]
        assert len(one) == 1 and torch.equal(one.source[0], cameras.source[2])
    assert torch.equal(cameras[[3, 0]].u, cameras.u[[3, 0]])
    assert len(list(cameras)) == 5


def test_rays_run_from_the_source_to_the_pixels():
    cameras = random_cameras(3)
    start, end = cameras.rays()
    assert start.shape == end.shape == (3, 7, 9, 3)
    torch.testing.assert_close(
        start, cameras.source[:, None, None].expand_as(start), rtol=0, atol=0
    )
    expected = cameras.origin + 6 * cameras.v + 8 * cameras.u
    torch.testing.assert_close(end[:, 6, 8], expected, rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize("parallel", [False, True])
def test_binned_pixels_are_centred_on_their_pixels(parallel):
    cameras = record(shape=(4, 6), parallel=parallel)
    coarse = cameras.binned(2)
    assert coarse.shape == (2, 3)
    for fine_ends, ends in zip(cameras.rays(), coarse.rays(), strict=True):
        mean = fine_ends.reshape(3, 2, 2, 3, 2, 3).mean(dim=(2, 4))
        torch.testing.assert_close(ends, mean, rtol=1e-12, atol=1e-12)
    for factor in (0, 4):
        with pytest.raises(ValueError, match=f"Binning by {factor} needs"):
            cameras.binned(factor)


@pytest.mark.parametrize("parallel", [False, True])
def test_transposed_detectors_keep_their_position(parallel):
    """The middle of the detector stays, and twice transposed is as before."""
    cameras = record(shape=(5, 8), parallel=parallel)
    other = cameras.transposed()
    assert other.shape == (8, 5)
    middle = cameras.origin + 3.5 * cameras.u + 2 * cameras.v
    torch.testing.assert_close(other.origin + 2 * other.u + 3.5 * other.v, middle)
    again = other.transposed()
    torch.testing.assert_close(again.origin, cameras.origin)
    torch.testing.assert_close(again.source, cameras.source)


def test_moving_rig_and_points_together_keeps_the_projection():
    cameras, rng = random_cameras(), torch.Generator().manual_seed(4)
    R, t = random_rotation(rng), torch.randn(3, generator=rng, dtype=torch.float64)
    xyz = 20 * torch.randn(9, 3, generator=rng, dtype=torch.float64)
    moved = cameras.moved(R, t)
    torch.testing.assert_close(
        moved.project(xyz @ R.T + t), cameras.project(xyz), rtol=1e-9, atol=1e-9
    )
    assert same(moved.moved(R.T, -R.T @ t), cameras)
    with pytest.raises(ValueError, match="left-handed"):
        cameras.moved(torch.diag(torch.tensor([1.0, 1, -1])), t)
    for given in ((R.tolist(), t), (R.numpy(), t), (R, None), (R, "t"), (R.to(torch.complex64), t)):
        with pytest.raises(TypeError, match="must be tensors of real numbers, got [Rt]="):
            cameras.moved(*given)


def test_each_camera_can_move_by_its_own_pose():
    """[m 3 3] and [m 3], and any of them with one for all: as cameras that are moved one by one."""
    cameras, rng = random_cameras(3), torch.Generator().manual_seed(4)
    R, t = random_rotation(rng, 3), torch.randn(3, 3, generator=rng, dtype=torch.float64)
    for rotation, translation in ((R, t), (R[0], t), (R, t[0]), (R[0], t[0]), (R.float(), t[1])):
        moved = cameras.moved(rotation, translation)
        for m, camera in enumerate(cameras):
            one = rotation if rotation.ndim == 2 else rotation[m]
            alone = camera.moved(one, translation if translation.ndim == 1 else translation[m])
            assert same(moved[m], alone)
            points = torch.randn(4, 3, generator=rng, dtype=torch.float64)
            there = points @ one.double().T + (
                translation if translation.ndim == 1 else translation[m]
            )
            torch.testing.assert_close(alone.project(there), camera.project(points))


SHAPES = {
    "more rotations than cameras": (
        "moved",
        ((2, 3, 3), (3,)),
        r"R \[3 3\] or \[3 3 3\] .*\[2, 3, 3\]",
    ),
    "one rotation of a batch": (
        "moved",
        ((1, 3, 3), (3,)),
        r"R \[3 3\] or \[3 3 3\] .*\[1, 3, 3\]",
    ),
    "a batch of rigs": ("moved", ((2, 3, 3, 3), (3,)), r"R \[3 3\] or .*\[2, 3, 3, 3\]"),
    "a pose of 3 x 4": ("moved", ((3, 4), (3,)), r"R \[3 3\] or .*\[3, 4\]"),
    "translations as columns": ("moved", ((3, 3), (3, 1)), r"t \[3\] or \[3 3\].*\[3, 1\]"),
    "too many translations": ("moved", ((3, 3), (2, 3)), r"t \[3\] or \[3 3\].*\[2, 3\]"),
    "a translation in the plane": ("moved", ((3, 3), (2,)), r"t \[3\] or \[3 3\].*\[2\]"),
    "a number as translation": ("moved", ((3, 3), ()), r"t \[3\] or \[3 3\].*\[\]"),
    "a shift without cameras": ("shifted", ((2,),), r"\[1 2\] or \[3 2\] pixels, got \[2\]"),
    "shifts in space": ("shifted", ((3, 3),), r"\[1 2\] or \[3 2\] pixels, got \[3, 3\]"),
    "shifts of other cameras": ("shifted", ((2, 2),), r"\[1 2\] or \[3 2\] pixels, got \[2, 2\]"),
    "points in the plane": ("project", ((3, 2),), r"Points must be \[.. 3\].*\[3, 2\]"),
    "two points per row": ("project", ((3, 6),), r"Points must be \[.. 3\].*\[3, 6\]"),
    "a number as point": ("project", ((),), r"Points must be \[.. 3\].*\[\]"),
    "images without cameras": ("unproject", ((6, 3),), r"\[3 .. 3\], .*\[6, 3\]"),
    "an image": ("unproject", ((3,),), r"\[3 .. 3\], .*\[3\]"),
    "images without depth": ("unproject", ((3, 3, 2),), r"\[3 .. 3\], .*\[3, 3, 2\]"),
    "depths of one camera": ("valid", ((1, 5, 3),), r"\[3 .. 3\], .*\[1, 5, 3\]"),
}


@pytest.mark.parametrize("name", SHAPES)
def test_other_shapes_are_refused(name: str):
    """In a sentence with the received and the expected shape; a rig of three, where [6 3] images,
    regrouped, would be two for each camera.
    """
    method, shapes, message = SHAPES[name]
    tensors = [torch.eye(3).expand(s) if s[-2:] == (3, 3) else torch.zeros(s) for s in shapes]
    with pytest.raises(ValueError, match=message):
        getattr(random_cameras(3), method)(*tensors)


@pytest.mark.parametrize("index", [(slice(None), slice(2)), (0, 1), torch.ones(3, 3) > 0, 3])
def test_only_cameras_are_indexed(index: object):
    """Not the entries of their vectors, which would be regrouped."""
    with pytest.raises(IndexError):
        random_cameras(3)[index]  # type: ignore[index]


def test_the_depth_range_bounds_the_grid_tightly():
    cameras = record()[0]
    grid = Grid.centred(size=(8, 6, 4), spacing=(1.0, 2.0, 5.0), centre=(1.0, 2.0, 3.0))
    torch.testing.assert_close(
        cameras.depth_range(grid), torch.tensor([[93.0, 113.0]], dtype=torch.float64)
    )


def test_the_limits_are_those_of_the_extent():
    assert record().ray_extent == (0.0, 1.0)
    assert random_cameras(extent="behind").ray_extent == (-math.inf, 0.0)


def test_pixel_centres_of_a_parallel_beam_project_to_themselves_at_any_depth():
    cameras = record(parallel=True, extent="line")
    start, end = cameras.rays()
    for w in (-3.0, 0.0, 2.0):
        uvz = cameras.project((start + w * (end - start))[0])[0]
        torch.testing.assert_close(uvz[..., :2], pixel_centres((4, 5)), rtol=0, atol=1e-12)
        torch.testing.assert_close(uvz[..., 2], torch.full((4, 5), 200 * w, dtype=torch.float64))
    assert torch.equal(
        cameras.matrix[:, 2], torch.tensor([[0.0, 0, 0, 1]] * 3, dtype=torch.float64)
    )
