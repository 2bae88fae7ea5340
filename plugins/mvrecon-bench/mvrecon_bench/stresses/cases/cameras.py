"""Cameras: distant positions, all sizes, rigid motions, conversions, points without an image,
nearly singular poses; rejected options and geometry.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry import lattice
from mvrecon.geometry.cameras import convert
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.files import from_file, save
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation, inverse, look_at, random_rotation
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon.testing import check_camera
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import DOUBLE, DoesNotApply, case, none_of, refused
from mvrecon_bench.stresses.subject import Subject
from mvrecon_bench.stresses.subjects import CameraSubject

EPS = torch.finfo(torch.float64).eps
#: Depths in mm at and near the plane of the source, and behind it.
NOUGHT = (0.0, -0.0, 1e-12, -1e-12, 1e-8, -1e-8, -7.0)
#: Perturbations that make a matrix invalid as a rotation.
NO_ROTATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "a mirror": lambda R: R * R.new_tensor([1.0, 1.0, -1.0]),
    "scaled by 1.001": lambda R: R * 1.001,
    "sheared by 1e-3": lambda R: R @ (torch.eye(3).to(R) + 1e-3 * torch.eye(3).to(R).roll(1, 0)),
    "nought": lambda R: R * 0,
    "NaN": lambda R: R * math.nan,
}
NO_DETECTORS = (
    *(("pixel_mm", bad) for bad in (0.0, -1.0, [1.0, 0.0], math.nan, math.inf)),
    *(("pixels", bad) for bad in (0, -3, [4, 0], 2.5, math.nan)),
    *(("offset_mm", bad) for bad in (math.nan, [0.0, math.inf])),
)


def motion(seed: int, like: Tensor, t: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """A random rotation, and a translation in mm."""
    return random_rotation(torch.Generator().manual_seed(seed)).to(like), like.new_tensor(t)


def relative(a: Tensor, b: Tensor) -> float:
    """Greatest difference relative to 1 + |b|."""
    return float(((a - b).abs() / (1 + b.abs())).max())


@case("camera", 10)
def without_image(subject: CameraSubject) -> float:
    """Points without an image: NaN and invalid; other points unchanged."""
    faults: dict[str, str] = {}
    for m, rig in enumerate(subject.few):
        places = about_the_source(rig, subject.side).to(subject.dtype)
        uvz = rig.project(torch.cat([places, nowhere(places[-1])]))[0]
        valid, n = rig.valid(uvz[None])[0], len(places)
        (uv, z), seen, ahead = uvz[:n].split([2, 1], dim=-1), valid[:n], uvz[n - 2 : n]
        alone = torch.stack([rig.project(point)[0] for point in places[-2:]])
        hits = {
            "not NaN from nowhere": ~uvz[n:].isnan(),
            "a valid image of nowhere": valid[n:],
            "a depth that is not finite": ~z.isfinite(),
            "an infinite pixel": uv.isinf(),
            "a valid image that is NaN": seen & uv.isnan().any(dim=-1),
            "a valid image behind": seen & (subject.side * z[:, 0] <= 0) & (not rig.parallel),
            "no image of what is ahead": ~valid[n - 2 : n],
            "changed by its neighbours": (ahead - alone).abs() > 1e-6 * (1 + alone.abs()),
        }
        faults |= {
            f"camera {m}: {what}": str(int(hit.sum())) for what, hit in hits.items() if hit.any()
        }
    return none_of(faults)


@case("camera", 10)
def slopes_without_image(subject: CameraSubject) -> Iterator[float]:
    """Gradients at points without an image: finite, for valid images and for unprojection."""
    for rig in subject.few:
        places = about_the_source(rig, subject.side).to(subject.dtype)
        points = torch.cat([places, nowhere(places[-1])]).requires_grad_()
        for back in (False, True):
            vectors = [getattr(rig, name).clone().requires_grad_() for name in VECTORS]
            leaf = replace(rig, **dict(zip(VECTORS, vectors, strict=True)))
            images = leaf.unproject(points[None]) if back else leaf.project(points)
            used = images.isfinite().all(dim=-1) if back else leaf.valid(images)
            total = torch.where(used[..., None], images, 0.0).sum()
            slopes = torch.autograd.grad(total, (points, *vectors))
            yield sum(int((~slope.isfinite()).sum()) for slope in slopes)


@case("camera", 11, 0.0, DOUBLE)
def towards_the_source(subject: CameraSubject) -> float:
    """Points close to the source: the Jacobian stays finite and increases."""
    rig = subject.few
    uv = rig.source.new_tensor([(n - 1) / 2 for n in rig.shape[::-1]]).expand(len(rig), 13, 2)
    z = subject.side * torch.logspace(3, -9, 13, dtype=torch.float64, device=rig.source.device)
    xyz = rig.unproject(torch.cat([uv, z.expand(len(rig), 13)[..., None]], dim=-1))
    jacobian = torch.stack([frustum_jacobian(rig, xyz[m])[m] for m in range(len(rig))])
    return float((~jacobian.isfinite()).sum() + (jacobian.diff(dim=1) < 0).sum())


@case("camera", 11, 0.0, DOUBLE)
def source_in_the_volume(subject: CameraSubject) -> float:
    """A source in the volume: lifts and warps are finite."""
    rig = subject.few
    step, centre = float(rig.distance[0]) / 10, rig.source[0].tolist()
    grid = Grid.centred(size=(6, 5, 4), spacing=step, centre=centre)
    frusta = Frusta.of(grid, rig, depth=6).to(rig.source.device)
    views = torch.ones(1, 1, len(rig), *rig.shape, device=rig.source.device, requires_grad=True)
    lifted = frusta.spread(views)
    world = frusta.to_volume(lifted)
    back = frusta.to_frusta(world)
    (slope,) = torch.autograd.grad(back.sum(), views)
    return float(sum((~tensor.isfinite()).sum() for tensor in (lifted, world, back, slope)))


@case("camera", 12, 1e-12, DOUBLE)
def of_any_size(subject: CameraSubject) -> Iterator[float]:
    """Cameras of any size: the same pixels, scaled depths, with pixels of 1e-9 to 1e9 mm."""
    rig, uvz = subject.few, subject.somewhere()
    xyz = rig.unproject(uvz)
    for scale in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        other = replace(rig, **{name: scale * getattr(rig, name) for name in VECTORS})
        images = torch.stack([other.project(scale * x)[m] for m, x in enumerate(xyz)])
        yield gap(other.distance, scale * rig.distance)
        yield gap(images[..., :2], uvz[..., :2])
        yield gap(images[..., 2], scale * uvz[..., 2])


@case("camera", 13, 1e-8, DOUBLE)
def far_away(subject: CameraSubject) -> Iterator[float]:
    """Cameras far away: the same pixels and depths up to 1e6 mm from the origin."""
    rig, uvz = subject.few, subject.somewhere()
    for offset in (0.0, 1e3, 1e4, 1e5, 1e6):
        R, t = motion(5, rig.source, (offset, -offset, offset))
        points, moved = rig.unproject(uvz) @ R.T + t, rig.moved(R, t)
        images = torch.stack([moved.project(x)[m] for m, x in enumerate(points)])
        yield relative(images, uvz)


@case("camera", 21, 1e-13, DOUBLE)
def sizes_alike(subject: CameraSubject) -> float:
    """Three cameras, three points: each as on its own."""
    rig, uvz = subject.few, subject.somewhere(3)
    R, t = motion(4, rig.source, (3.0, -5.0, 7.0))
    xyz, moved = rig.unproject(uvz), rig.moved(R, t)
    every, three = rig.project(xyz), rig.project(xyz[0])
    pairs: list[tuple[Tensor, Tensor]] = [(rig.unproject(three)[:, 0], xyz[0, 0].expand(3, 3))]
    for m in range(3):
        pairs += [(rig.matrix[m], rig[m].matrix[0]), (rig.rays()[1][m], rig[m].rays()[1][0])]
        pairs += [(xyz[m, n], rig[m].unproject(uvz[m : m + 1, n])[0]) for n in range(3)]
        pairs += [
            (every[m, k, n], rig[m].project(xyz[k, n])[0]) for k in range(3) for n in range(3)
        ]
        pairs += [(three[m, n], every[m, 0, n]) for n in range(3)]
        pairs += [(getattr(moved[m], name), getattr(rig[m].moved(R, t), name)) for name in VECTORS]
        pairs += [(moved.source[m], R @ rig.source[m] + t), (moved.u[m], R @ rig.u[m])]
    mask = torch.tensor([True, False, True], device=rig.source.device)
    for chosen in ([2, 0, 1], mask, slice(1, 3), -1, torch.tensor(1)):
        of = [(getattr(rig[chosen], name), getattr(rig, name)[chosen]) for name in VECTORS]
        pairs += [(a, b.reshape(-1, 3)) for a, b in of]
    return greatest(relative(a, b) for a, b in pairs)


@case("mvrecon", 22, 1e-12, DOUBLE)
def up_along_the_view(_: Subject) -> Iterator[float]:
    """Up vector along the viewing direction: proper rotations, finite gradients."""
    tilts = (0.0, 1e-300, 1e-12, 1e-9, 1e-8, 2e-8, 1e-7, 1e-6, 1e-3)
    for up in ((0.0, 0.0, 1.0), (0.0, 1e-200, 0.0), (1.0, 2.0, -3.0), (0.0, 0.0, 0.0)):
        axis = torch.tensor(up, dtype=torch.float64)
        along = torch.nn.functional.normalize(axis if axis.norm() > 0 else axis + 1, dim=0)
        aside = torch.linalg.cross(along, torch.eye(3, dtype=torch.float64)[along.abs().argmin()])
        ways = [70 * (s * along + tilt * aside) for tilt in tilts for s in (1, -1)]
        target = torch.stack(ways).requires_grad_()
        R = look_at(torch.zeros_like(target), target, up)
        yield improper(R, target)


@case("camera", 23, 1e-10, DOUBLE)
def conversions(subject: CameraSubject) -> float:
    """Conversions and back: the same rig, through other libraries' conventions and a file."""
    return greatest(rig_error(other, subject.few) for other in _there_and_back(subject.few))


def _there_and_back(rig: Cameras) -> Iterator[Cameras]:
    shape, extent = rig.shape, rig.extent
    yield convert.from_astra(convert.to_astra(rig), shape, rig.parallel, extent)
    with TemporaryDirectory() as folder:
        save(rig, f"{folder}/rig.json")
        yield from_file(f"{folder}/rig.json").to(rig.source.device)
    if not rig.parallel:
        yield convert.from_krt(*convert.to_krt(rig), shape, rig.distance, extent)
        yield convert.from_matrix(rig.matrix, shape, rig.distance, extent)
        yield convert.from_kornia(*convert.to_kornia(rig)[:2], shape, rig.distance, extent)


def rig_error(rig: Cameras, expected: Cameras) -> float:
    """Difference of two rigs relative to the length of each vector."""
    alike = [(cameras.shape, cameras.parallel, cameras.extent) for cameras in (rig, expected)]
    assert alike[0] == alike[1], f"expected (shape, parallel, extent) {alike[1]}, got {alike[0]}"
    return greatest(gap(getattr(rig, name), getattr(expected, name)) for name in VECTORS)


@case("mvrecon", 23, 10, DOUBLE)
def nearly_singular(_: Subject) -> Iterator[float]:
    """Nearly singular K: the same K, R, t within eps cond(K), or an error."""
    R, t = motion(2, torch.zeros(1, dtype=torch.float64), (3.0, -2.0, 50.0))
    for power in range(17):
        c = 10.0**power
        for fx, fy, skew, cx in (
            (1 / c, 1, 0, 0),
            (c, c, 0, 12),
            (100, 100, c, 12),
            (100, 100, 0, c),
        ):
            K = torch.tensor([[[fx, skew, cx], [0, fy, 7 * (fy > 1)], [0, 0, 1]]]).double()
            cond = float(torch.linalg.cond(K))
            try:
                krt = convert.to_krt(convert.from_krt(K, R[None], t[None], (6, 5), 80.0))
            except ValueError as error:
                assert re.search(r"(determinant|condition)\D*\d", str(error)), f"{K}: {error}"
                assert cond > 1e6, f"{K}, of condition {cond:.0e}, is refused: {error}"
                continue
            yield from [
                gap(a, b[None]) / (EPS * cond) for a, b in zip(krt, (K[0], R, t), strict=True)
            ]


@case("camera", 24, 1e-13, DOUBLE)
def moved_back(subject: CameraSubject) -> float:
    """Moved, and moved back: the same rig."""
    rig, (R, t) = subject.few, motion(6, subject.few.source, (30.0, -50.0, 70.0))
    return rig_error(rig.moved(R, t).moved(*inverse(R, t)), rig)


@case("camera", 24, 0.0, DOUBLE)
def bad_motions(subject: CameraSubject) -> float:
    """Motions that are not rigid, in the rig and in K, R, t and kornia's extrinsics: an error that
    names it.
    """
    move, (R, t) = subject.few.moved, motion(7, subject.few.source, (0.0, 0.0, 0.0))
    four = torch.eye(4).to(R).repeat(2, 1, 1)
    acts: dict[str, Callable[[], object]] = {"translation": partial(move, R, t * math.nan)}
    for name, change in NO_ROTATIONS.items():
        bad, extrinsics = torch.stack([R, change(R)]), four.clone()
        extrinsics[:, :3, :3] = bad
        krt = four[:, :3, :3], bad, t.expand(2, 3), (6, 5), 70.0
        acts[f"moved, {name}"] = partial(move, change(R), t)
        acts[f"R must be, {name}"] = partial(convert.from_krt, *krt)
        acts[f"must be, {name}"] = partial(convert.from_kornia, four, extrinsics, (6, 5), 70.0)
    words = {"moved": "(?i)rotation"}
    return refused(acts, lambda name: words.get(key := name.split(",")[0], key))


@case("mvrecon", 25, 1e-10, DOUBLE)
def special_rotations(_: Subject) -> Iterator[float]:
    """Rotations by 0 and 180 degrees: proper rotations with inverses."""
    close = [x + tiny for x in (0.0, 37.0, 90.0, 180.0) for tiny in (0.0, 1e-300, -1e-7, 1e-7)]
    for axes in ("zyz", "xyz", "zxx"):
        three = [torch.tensor(close, dtype=torch.float64)] * 3
        angles = torch.cartesian_prod(*three).requires_grad_()
        R = euler_rotation(angles, axes)
        undone = R.detach() @ euler_rotation(-angles.detach().flip(-1), axes[::-1])
        yield improper(R, angles)
        yield float((undone - torch.eye(3).to(undone)).abs().amax())


@case("camera", 48, 0.0, DOUBLE)
def bad_options(subject: CameraSubject) -> float:
    """Options that are not numbers: an error that names it."""
    assert len(subject.cameras)  # raises DoesNotApply if it cannot be built
    with subject.given() as options:
        defaults = {name: one.default for name, one in subject.parameters.items()} | options
        numbers = [name for name, value in defaults.items() if isinstance(value, float)]
        changes = {f"{name} {bad}": {name: bad} for name in numbers for bad in (math.nan, math.inf)}
        if isinstance(detector := options.get("detector"), dict):
            bad = {f"{name} {bad}": {**detector, name: bad} for name, bad in NO_DETECTORS}
            changes |= {what: {"detector": value} for what, value in bad.items()}
        if not changes:
            raise DoesNotApply("none of its options is a length or an angle")
        build: Callable[..., Any] = partial(subject.build, **options)
        acts = {what: partial(build, **bad) for what, bad in changes.items()}
        return refused(acts, lambda what: what.split()[0])


@case("camera", 61, 0.0, DOUBLE)
def contract(subject: CameraSubject) -> float:
    """check_camera: passes."""
    assert len(subject.cameras)  # raises DoesNotApply if it cannot be built
    with subject.given() as options:
        check_camera(subject.name, **options)
    return 0.0


def about_the_source(rig: Cameras, side: float) -> Tensor:
    """Points in, near and (the last two) in front of the plane of the first source, on and off its
    axis, in mm [n 3].
    """
    across = torch.stack([torch.zeros_like(rig.u[0]), 0.7 * rig.u[0] - 0.4 * rig.v[0]])
    normal = torch.nn.functional.normalize(torch.linalg.cross(rig.u[0], rig.v[0]), dim=0)
    normal = normal * (normal @ (rig.origin - rig.source)[0]).sign()
    depths = side * rig.source.new_tensor([*NOUGHT, 0.3 * float(rig.distance[0])])
    return (rig.source[0] + across + depths[:, None, None] * normal).flatten(0, 1)


def nowhere(like: Tensor) -> Tensor:
    """Points [9 3] with one NaN or infinite coordinate each."""
    bad = like.new_tensor([math.nan, math.inf, -math.inf])
    axis = torch.eye(3, dtype=torch.bool, device=like.device)
    return torch.where(axis[:, None], bad[:, None], like).flatten(0, 1)


def frustum_jacobian(
    cameras: Cameras, xyz: Float[Tensor, "*n 3"], f: float = 1.0
) -> Float[Tensor, "m *n"]:
    """Volume in (u, v, k) per mm^3 at world points, |det H| / w^4; a count-preserving density is
    divided by it.
    """
    H = lattice.to_frustum(cameras, f)
    w = H[:, 3, :3] @ xyz.reshape(-1, 3).to(H).T + H[:, 3, 3:]
    return (torch.linalg.det(H).abs()[:, None] / w**4).reshape(len(cameras), *xyz.shape[:-1])


def improper(R: Tensor, of: Tensor) -> float:
    """Distance of matrices from rotations: the largest entry of R R^T - 1 and det R - 1.

    Raises:
        AssertionError: their derivatives by what they are computed from are not finite.
    """
    (slope,) = torch.autograd.grad(
        (R * torch.arange(9.0).reshape(3, 3)).sum(), of, retain_graph=True
    )
    assert slope.isfinite().all(), "gradients of rotations are not finite"
    off = (R @ R.mT - torch.eye(3).to(R)).abs().amax()
    return float(torch.maximum(off, (torch.linalg.det(R) - 1).abs().amax()))
