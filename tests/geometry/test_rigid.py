import math

import pytest
import torch

from mvrecon.geometry.rigid import (
    euler_degrees,
    euler_rotation,
    inverse,
    look_at,
    random_in_ball,
    random_rotation,
)

EYE = torch.eye(3, dtype=torch.float64)


def assert_rotations(R):
    torch.testing.assert_close(R @ R.mT, EYE.expand_as(R), atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), R.new_ones(R.shape[:-2]), atol=1e-12, rtol=0)


def turn(axis, degrees):
    """A right-handed turn about an axis, written out."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = EYE.clone()
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


@pytest.mark.parametrize("axes", ["zyz", "xyz", "zxy", "zxz"])
def test_euler_rotations_compose_from_left_to_right(axes):
    angles = (30.0, -75.0, 200.0)
    R = euler_rotation(angles, axes)
    assert_rotations(R)
    a, b, c = (turn(axis, angle) for axis, angle in zip(axes, angles, strict=True))
    torch.testing.assert_close(R, a @ b @ c, atol=1e-12, rtol=0)


def test_euler_rotations_support_batches():
    angles = torch.tensor([[[0.0, 0.0, 0.0], [90.0, 0.0, 0.0]]])
    R = euler_rotation(angles)
    assert R.shape == (1, 2, 3, 3) and R.dtype == torch.float64
    torch.testing.assert_close(R[0, 0], EYE)
    torch.testing.assert_close(R[0, 1] @ EYE[0], EYE[1], atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("angles", "axes"), [((1, 2), "zyz"), (5.0, "zyz"), ((1, 2, 3), "zy"), ((1, 2, 3), "abc")]
)
def test_invalid_euler_angles_are_refused(angles, axes):
    with pytest.raises(ValueError, match="Euler .* got"):
        euler_rotation(angles, axes)


def test_random_rotations_are_uniform():
    R = random_rotation(torch.Generator().manual_seed(0), 20_000)
    assert_rotations(R)
    assert R.mean(dim=0).abs().max() < 0.02  # each entry has mean 0 and variance 1/3
    torch.testing.assert_close((R**2).mean(dim=0), torch.full_like(EYE, 1 / 3), atol=0.02, rtol=0)
    # the angle of a uniform rotation has the density (1 - cos a) / pi, so its mean is pi/2 + 2/pi
    angle = ((R.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2).clamp(-1, 1).arccos()
    assert angle.mean().item() == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.02)


def test_a_random_rotation_depends_only_on_its_generator():
    draw = lambda: random_rotation(torch.Generator().manual_seed(5))  # noqa: E731
    assert draw().shape == (3, 3) and torch.equal(draw(), draw())


def test_points_fill_the_ball_evenly():
    rng = torch.Generator().manual_seed(0)
    r = torch.stack([random_in_ball(rng, 4.0) for _ in range(4000)])
    assert r.norm(dim=1).max() <= 4 and r.mean(dim=0).abs().max() < 0.15
    assert (r.norm(dim=1) < 2).float().mean().item() == pytest.approx(1 / 8, abs=0.02)


def test_a_motion_and_its_inverse_cancel():
    rng = torch.Generator().manual_seed(1)
    R, t = random_rotation(rng, 5), torch.randn(5, 3, generator=rng, dtype=torch.float64)
    Q, s = inverse(R, t)
    x = torch.randn(5, 3, generator=rng, dtype=torch.float64)
    moved = (R @ x[..., None])[..., 0] + t
    torch.testing.assert_close((Q @ moved[..., None])[..., 0] + s, x, atol=1e-12, rtol=0)


def test_a_camera_looks_at_its_target_with_up_upwards():
    rng = torch.Generator().manual_seed(2)
    source = torch.randn(50, 3, generator=rng, dtype=torch.float64) * 100
    target = torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64).expand_as(source)
    R = look_at(source, target)
    assert_rotations(R)
    in_camera = (R @ (target - source)[..., None])[..., 0]
    torch.testing.assert_close(
        in_camera[:, :2], torch.zeros_like(in_camera[:, :2]), atol=1e-10, rtol=0
    )
    torch.testing.assert_close(in_camera[:, 2], (target - source).norm(dim=1))
    up = R @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert up[:, 0].abs().max() < 1e-12 and (up[:, 1] < 0).all()  # image y points downwards


@pytest.mark.parametrize("height", [100.0, -100.0])
def test_a_camera_above_or_below_its_target_has_valid_axes(height):
    R = look_at(torch.tensor([0.0, 0.0, height]), torch.zeros(3))
    assert_rotations(R)
    torch.testing.assert_close(R[2], -math.copysign(1, height) * EYE[2])


@pytest.mark.parametrize("nudge", [1e-13, -1e-13, 1e-10])
def test_rounding_does_not_turn_a_camera_whose_up_is_its_line_of_sight(nudge):
    """About any axis of the world."""
    for axis, aside in ((2, 0), (2, 1), (0, 1), (0, 2), (1, 0), (1, 2)):
        source = 100 * EYE[axis]
        R = look_at(source, torch.zeros(3), EYE[axis].tolist())
        near = look_at(source + 100 * nudge * EYE[aside], torch.zeros(3), EYE[axis].tolist())
        torch.testing.assert_close(near, R)


def test_a_camera_at_its_target_is_refused():
    with pytest.raises(ValueError, match="must not be at the point"):
        look_at(torch.ones(2, 3), torch.ones(2, 3))


def test_euler_angles_reproduce_the_rotation():
    R = random_rotation(torch.Generator().manual_seed(2), 50)
    assert torch.allclose(euler_rotation(euler_degrees(R)), R, atol=1e-12)
    turns = torch.tensor([[30.0, 0, 40], [30, 180, 40], [-170, 0, 0], [10, 90, -100]])
    same = euler_rotation(euler_degrees(euler_rotation(turns)))
    assert torch.allclose(same, euler_rotation(turns), atol=1e-9)
    assert euler_degrees(euler_rotation((20, 130, -50))).tolist() == pytest.approx([20, 130, -50])
