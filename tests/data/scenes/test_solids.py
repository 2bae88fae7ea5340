import itertools
import math

import pytest
import torch

from mvrecon.data.scenes.solids import ROUND_AXES, Phantom, Solids
from mvrecon.geometry.rigid import random_rotation

INF = math.inf


def points(*xyz):
    return torch.tensor(xyz, dtype=torch.float64)


def one(kind="ellipsoid", centre=(0, 0, 0), axes=(1, 1, 1), value=1.0, R=None):
    R = torch.eye(3, dtype=torch.float64) if R is None else R
    return Phantom((Solids(kind, points(centre), R[None], points(axes), torch.tensor([value])),))


def many(kind, n, rng):
    draw = lambda *shape: torch.rand(*shape, generator=rng, dtype=torch.float64)  # noqa: E731
    return Solids(
        kind, draw(n, 3) * 30 - 15, random_rotation(rng, n), 4 + 12 * draw(n, 3), draw(n) - 0.3
    )


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(7)


@pytest.fixture
def mixed(rng):
    return Phantom(tuple(many(kind, 4, rng) for kind in ROUND_AXES))


@pytest.fixture
def rays(rng):
    ends = torch.randn(2, 60, 3, generator=rng, dtype=torch.float64)
    start = 80 * torch.nn.functional.normalize(ends[0], dim=-1)
    return start, -2 * start + 25 * ends[1]


@pytest.mark.pairwise(axis=range(3), kind=ROUND_AXES)
def test_a_ray_along_an_axis_through_the_centre_crosses_both_semi_axes(kind, axis):
    R = random_rotation(torch.Generator().manual_seed(axis))
    solid = one(kind, (3, -2, 5), (4, 7, 11), 2.5, R)
    centre = points((3, -2, 5))
    chord = solid.integrals(centre - 100 * R[:, axis], centre + 50 * R[:, axis])
    assert chord.item() == pytest.approx(2.5 * 2 * (4, 7, 11)[axis], rel=1e-12)


def test_a_sphere_has_the_chord_of_pythagoras():
    offset = torch.linspace(0, 9.99, 50, dtype=torch.float64)
    start = torch.stack([torch.full_like(offset, -1000), offset, torch.zeros_like(offset)], dim=-1)
    end = start * points((-1, 1, 1))
    chord = one(axes=(10, 10, 10)).integrals(start, end)
    torch.testing.assert_close(chord, 2 * (100 - offset**2).sqrt(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["ellipsoid", "cylinder"])
def test_tangent_and_missing_rays_have_no_chord(kind):
    start = points((-9, 1, 0), (-9, 1.5, 0), (-9, 0, 4.0))
    end = points((9, 1, 0), (9, 1.5, 0), (9, 0, 4.0))
    assert one(kind, axes=(1, 1, 3)).integrals(start, end).tolist() == [0, 0, 0]


@pytest.mark.parametrize("kind", ["cylinder", "box"])
def test_a_ray_along_the_side_is_in_or_out(kind):
    start = points((0.5, 0.5, -9), (1.5, 0, -9), (-0.9, 0.9, -9))
    end = points((0.5, 0.5, 9), (1.5, 0, 9), (-0.9, 0.9, 9))
    corner = 6.0 if kind == "box" else 0.0
    for extent in ((0.0, 1.0), (-INF, INF)):
        assert one(kind, axes=(1, 1, 3)).integrals(start, end, extent).tolist() == [6, 0, corner]


def test_a_ray_in_the_face_of_a_box_only_touches_it():
    assert one("box").integrals(points((1, 0, -9)), points((1, 0, 9))).item() == 0


def test_a_skew_ray_through_a_box_and_a_cylinder():
    diagonal = points((-5, -5, -5)), points((5, 5, 5))
    assert one("box").integrals(*diagonal).item() == pytest.approx(2 * math.sqrt(3))
    # it leaves the round wall of radius 1 at x = y = 1/sqrt(2), before the caps at |z| = 1
    assert one("cylinder").integrals(*diagonal).item() == pytest.approx(math.sqrt(6))
    assert one("cylinder", axes=(9, 9, 1)).integrals(*diagonal).item() == pytest.approx(
        2 * math.sqrt(3)
    )


def test_integrals_are_the_sum_of_the_values(mixed, rays):
    start, end = rays
    n = 40000
    w = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    length = (end - start).norm(dim=-1)
    sums = torch.stack(
        [
            mixed.values(s + w[:, None] * (e - s)).mean()
            for s, e in zip(start[:20], end[:20], strict=True)
        ]
    )
    exact = mixed.integrals(start, end)[:20]
    assert (exact.abs() > 1).sum() > 10
    error = (sums * length[:20] - exact).norm() / exact.norm()
    assert error < 1e-3


def test_moving_the_phantom_and_the_rays_changes_nothing(mixed, rays, rng):
    R, t = random_rotation(rng), 100 * torch.randn(3, generator=rng, dtype=torch.float64)
    start, end = (x @ R.T + t for x in rays)
    torch.testing.assert_close(
        mixed.moved(R, t).integrals(start, end), mixed.integrals(*rays), rtol=1e-10, atol=1e-10
    )
    torch.testing.assert_close(
        mixed.moved(R, t).values(start * 0.1), mixed.values((start * 0.1 - t) @ R)
    )


def test_a_distant_source_loses_no_precision():
    direction = torch.nn.functional.normalize(points((1.0, 2.0, -0.5)), dim=-1)
    across = (
        torch.nn.functional.normalize(
            torch.linalg.cross(direction, points((0.0, 0.0, 1.0))), dim=-1
        )
        * 6
    )
    chord = one(axes=(10, 10, 10)).integrals(across - 1e6 * direction, across + 1e6 * direction)
    assert chord.item() == pytest.approx(16, rel=1e-9)


def test_only_the_extent_counts(mixed, rays):
    start, end = rays
    middle = (start + end) / 2
    behind, ahead, line = (
        mixed.integrals(middle, end, e) for e in ((-INF, 0.0), (0.0, INF), (-INF, INF))
    )
    torch.testing.assert_close(behind + ahead, line)
    torch.testing.assert_close(behind, mixed.integrals(start, middle))
    torch.testing.assert_close(ahead, mixed.integrals(middle, end))
    assert not torch.allclose(behind, line)
    sphere = one(centre=(5, 0, 0))
    assert sphere.integrals(points((0, 0, 0)), points((1, 0, 0)), (-INF, 0.0)).item() == 0
    assert sphere.integrals(
        points((0, 0, 0)), points((-1, 0, 0)), (-INF, 0.0)
    ).item() == pytest.approx(2)
    assert sphere.integrals(points((0, 0, 0)), points((5, 0, 0))).item() == pytest.approx(1)


def test_parts_add_up(mixed, rays):
    apart = sum(Phantom((part,)).integrals(*rays) for part in mixed.parts)
    torch.testing.assert_close(mixed.integrals(*rays), apart)


def test_shapes_dtypes_and_chunks(mixed, rays, monkeypatch):
    start, end = (x.reshape(3, 4, 5, 3) for x in rays)
    whole = mixed.integrals(start, end)
    assert whole.shape == (3, 4, 5) and whole.dtype == torch.float64
    assert mixed.integrals(start.float(), end.float()).dtype == torch.float32
    assert mixed.values(start.float()).shape == (3, 4, 5)
    monkeypatch.setattr("mvrecon.data.scenes.solids.PAIRS", 30)
    torch.testing.assert_close(mixed.integrals(start, end), whole)
    torch.testing.assert_close(
        mixed.integrals(start[0, 0, 0], end), mixed.integrals(start[:1, :1, :1].expand_as(end), end)
    )


def test_the_order_of_the_solids_does_not_matter(rng, rays):
    solids = many("ellipsoid", 5, rng)
    sums = []
    for order in itertools.islice(itertools.permutations(range(5)), 0, 120, 40):
        pick = list(order)
        sums.append(
            Phantom(
                (
                    Solids(
                        "ellipsoid",
                        solids.centres[pick],
                        solids.rotations[pick],
                        solids.semi_axes[pick],
                        solids.values[pick],
                    ),
                )
            ).integrals(*rays)
        )
    for other in sums[1:]:
        torch.testing.assert_close(other, sums[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "torus"}, "torus"),
        ({"axes": (1, 0, 1)}, "positive semi-axes"),
        ({"axes": (1, -2, 1)}, "positive semi-axes"),
        ({"axes": (1, 2)}, "semi_axes"),
        ({"centre": (0, math.nan, 0)}, "finite centres"),
        ({"value": INF}, "finite values"),
        ({"R": 2 * torch.eye(3)}, "orthonormal"),
    ],
)
def test_invalid_solids_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        one(**change)
