"""Cameras: points that have no image, sizes that could be mistaken for one another, far places, bad
options.
"""

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from mvrecon.cameras import convert
from mvrecon.cameras.camera import VECTORS, Cameras
from mvrecon.cameras.files import from_file, save
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import inverse, random_rotation
from mvrecon.models.frusta import Frusta
from mvrecon.parts import CAMERAS
from mvrecon.testing import check_camera
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.refusals import none_of, refusal
from mvrecon_bench.stresses.rig import CameraSubject
from mvrecon_bench.stresses.subject import gap, greatest

#: Geometry is worked out in float64, whatever the dtype of volumes and views.
EXACT = (torch.float64,)
#: Depths in mm at and about the plane of the source, and behind it.
NOUGHT = (0.0, -0.0, 1e-12, -1e-12, 1e-8, -1e-8, -7.0)


def contract(subject: CameraSubject) -> float:
    """`mvrecon.testing.check_camera`."""
    assert len(
        subject.cameras
    )  # it can be built with what it is given, or none of this is meant for it
    with subject.given() as options:
        check_camera(subject.name, **options)
    return 0.0


def about_the_source(rig: Cameras, side: float) -> Tensor:
    """Points in, about and (the last two) before the plane of the first source, on and off its
    axis, in mm [n 3].
    """
    across = torch.stack([torch.zeros_like(rig.u[0]), 0.7 * rig.u[0] - 0.4 * rig.v[0]])
    normal = torch.nn.functional.normalize(torch.linalg.cross(rig.u[0], rig.v[0]), dim=0)
    normal = normal * (normal @ (rig.origin - rig.source)[0]).sign()
    depths = side * rig.source.new_tensor([*NOUGHT, 0.3 * float(rig.distance[0])])
    return (rig.source[0] + across + depths[:, None, None] * normal).flatten(0, 1)


def nowhere(like: Tensor) -> Tensor:
    """Points [9 3] of which one coordinate each is no number, or infinite."""
    bad = like.new_tensor([math.nan, math.inf, -math.inf])
    axis = torch.eye(3, dtype=torch.bool, device=like.device)
    return torch.where(axis[:, None], bad[:, None], like).flatten(0, 1)


def without_image(subject: CameraSubject) -> float:
    """Points in the plane of the source, behind it, and of no place: what is made of them, and what
    is said of it.
    """
    found: dict[str, str] = {}
    for m, rig in enumerate(subject.few):
        places = about_the_source(rig, subject.side).to(subject.dtype)
        points = torch.cat([places, nowhere(places[-1])])
        uvz = rig.project(points)[0]
        valid, (uv, z) = rig.valid(uvz[None])[0], uvz[: len(places)].split([2, 1], dim=-1)
        alone = torch.stack([rig.project(point)[0] for point in places])
        hits = {
            "not NaN from nowhere": ~uvz[len(places) :].isnan(),
            "a valid image of nowhere": valid[len(places) :],
            "a depth that is not finite": ~z.isfinite(),
            "an infinite pixel": uv.isinf(),
            "a valid image that is NaN": valid[: len(places)] & uv.isnan().any(dim=-1),
            "a valid image behind": valid[: len(places)]
            & (subject.side * z[:, 0] <= 0)
            & (not rig.parallel),
            "no image of what is ahead": ~valid[len(places) - 2 : len(places)],
            "changed by its neighbours": (
                (uvz[-2 - 9 : -9] - alone[-2:]).abs() > 1e-6 * (1 + alone[-2:].abs())
            ),
        }
        found |= {
            f"camera {m}: {what}": str(int(hit.sum())) for what, hit in hits.items() if hit.any()
        }
    return none_of(found)


def slopes_without_image(subject: CameraSubject) -> float:
    """Gradients of valid images alone, with points that have none beside them; and of the way
    back.
    """
    wrong = 0
    for rig in subject.few:
        places = about_the_source(rig, subject.side).to(subject.dtype)
        points = torch.cat([places, nowhere(places[-1])]).requires_grad_()
        for back in (False, True):
            vectors = [getattr(rig, name).clone().requires_grad_() for name in VECTORS]
            leaf = replace(rig, **dict(zip(VECTORS, vectors, strict=True)))
            found = leaf.unproject(points[None]) if back else leaf.project(points)
            used = found.isfinite().all(dim=-1) if back else leaf.valid(found)
            gradients = torch.autograd.grad(
                torch.where(used[..., None], found, 0.0).sum(), (points, *vectors)
            )
            wrong += sum(int((~gradient.isfinite()).sum()) for gradient in gradients)
    return wrong


def towards_the_source(subject: CameraSubject) -> float:
    """The frustum's Jacobian, |det H| / w^4, on the way from 1000 mm to the source."""
    rig = subject.few
    uv = rig.source.new_tensor([(n - 1) / 2 for n in rig.shape[::-1]]).expand(len(rig), 13, 2)
    z = subject.side * torch.logspace(3, -9, 13, dtype=torch.float64, device=rig.source.device)
    xyz = rig.unproject(torch.cat([uv, z.expand(len(rig), 13)[..., None]], dim=-1))
    jacobian = torch.stack([convert.frustum_jacobian(rig, xyz[m])[m] for m in range(len(rig))])
    return float((~jacobian.isfinite()).sum() + (jacobian.diff(dim=1) < 0).sum())


def source_in_the_volume(subject: CameraSubject) -> float:
    """Lifts and warps of frusta whose source is in the middle of the grid."""
    rig = subject.few
    step = float(rig.distance[0]) / 10
    frusta = Frusta.of(Grid.centred((4, 5, 6), step, rig.source[0].tolist()), rig, depth=6).to(
        rig.source.device
    )
    views = torch.ones(1, 1, len(rig), *rig.shape, device=rig.source.device, requires_grad=True)
    lifted = frusta.spread(views)
    world = frusta.to_world(lifted)
    back = frusta.to_frusta(world)
    (slope,) = torch.autograd.grad(back.sum(), views)
    return float(sum((~each.isfinite()).sum() for each in (lifted, world, back, slope)))


def sizes_alike(subject: CameraSubject) -> float:
    """Three cameras, three points, three coordinates: each alone gives what all together give."""
    rig, uvz = subject.few, subject.somewhere(3)
    R, t = (
        random_rotation(torch.Generator().manual_seed(4)).to(rig.source),
        rig.source.new_tensor([3.0, -5.0, 7.0]),
    )
    xyz, moved = rig.unproject(uvz), rig.moved(R, t)
    every, three = rig.project(xyz), rig.project(xyz[0])
    mask = torch.tensor([True, False, True], device=rig.source.device)
    pairs: list[tuple[Tensor, Tensor]] = []
    for m in range(3):
        pairs += [(xyz[m, n], rig[m].unproject(uvz[m : m + 1, n])[0]) for n in range(3)]
        pairs += [
            (every[m, k, n], rig[m].project(xyz[k, n])[0]) for k in range(3) for n in range(3)
        ]
        pairs += [(three[m, n], every[m, 0, n]) for n in range(3)]
        pairs += [(getattr(moved[m], name), getattr(rig[m].moved(R, t), name)) for name in VECTORS]
        pairs += [(moved.source[m], R @ rig.source[m] + t), (moved.u[m], R @ rig.u[m])]
    for chosen in ([2, 0, 1], mask, slice(1, 3), -1, torch.tensor(1)):
        pairs += [
            (getattr(rig[chosen], name), getattr(rig, name)[chosen].reshape(-1, 3))
            for name in VECTORS
        ]
    return greatest(float(((a - b).abs() / (1 + b.abs())).max()) for a, b in pairs)


def far_away(subject: CameraSubject) -> float:
    """Cameras and points moved together by up to 1e6 mm: the same pixels and depths."""
    rig, uvz = subject.few, subject.somewhere()
    errors, R = [], random_rotation(torch.Generator().manual_seed(5)).to(rig.source)
    for offset in (0.0, 1e3, 1e4, 1e5, 1e6):
        t = rig.source.new_tensor([offset, -offset, offset])
        moved = rig.moved(R, t)
        seen = torch.stack(
            [moved.project(x @ R.T + t)[m] for m, x in enumerate(rig.unproject(uvz))]
        )
        errors.append(float(((seen - uvz).abs() / (1 + uvz.abs())).max()))
    return greatest(errors)


def of_any_size(subject: CameraSubject) -> float:
    """Cameras and points scaled together, down to pixels of 1e-9 and up to 1e9 mm: the same pixels,
    depths to scale.
    """
    rig, uvz = subject.few, subject.somewhere()
    xyz, errors = rig.unproject(uvz), []
    for scale in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        other = replace(rig, **{name: scale * getattr(rig, name) for name in VECTORS})
        seen = torch.stack([other.project(scale * x)[m] for m, x in enumerate(xyz)])
        errors += [gap(other.distance, scale * rig.distance), gap(seen[..., :2], uvz[..., :2])]
        errors.append(gap(seen[..., 2], scale * uvz[..., 2]))
    return greatest(errors)


def moved_back(subject: CameraSubject) -> float:
    """A rigid motion and its inverse, the transpose: the same rig."""
    rig, R = subject.few, random_rotation(torch.Generator().manual_seed(6)).to(subject.few.source)
    t = rig.source.new_tensor([30.0, -50.0, 70.0])
    return apart(rig.moved(R, t).moved(*inverse(R, t)), rig)


def bad_motions(subject: CameraSubject) -> float:
    """The rig moved by what is no rigid motion."""
    R, t = random_rotation(torch.Generator().manual_seed(7)), torch.zeros(3)
    bad = {name: (change(R), t) for name, change in NO_ROTATIONS.items()}
    found = {
        name: refusal(partial(subject.few.moved, *motion), "(?i)rotation")
        for name, motion in bad.items()
    }
    return none_of(
        found | {"t is NaN": refusal(partial(subject.few.moved, R, t * math.nan), "translation")}
    )


#: What makes of a rotation something else.
NO_ROTATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "a mirror": lambda R: R * R.new_tensor([1.0, 1.0, -1.0]),
    "scaled by 1.001": lambda R: R * 1.001,
    "sheared by 1e-3": lambda R: R @ (torch.eye(3).to(R) + 1e-3 * torch.eye(3).to(R).roll(1, 0)),
    "nought": lambda R: R * 0,
    "NaN": lambda R: R * math.nan,
}


def conversions(subject: CameraSubject) -> float:
    """To the terms of other libraries, to a file, and back: the same rig."""
    return greatest(apart(other, subject.few) for other in _there_and_back(subject.few))


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


def apart(found: Cameras, expected: Cameras) -> float:
    """How far two rigs are apart, of the size of each vector."""
    alike = [(each.shape, each.parallel, each.extent) for each in (found, expected)]
    assert alike[0] == alike[1], f"expected (shape, parallel, extent) {alike[1]}, got {alike[0]}"
    pairs = [(getattr(found, name), getattr(expected, name)) for name in VECTORS]
    return greatest(gap(a, b) for a, b in pairs)


def bad_options(subject: CameraSubject) -> float:
    """A number among its options that is NaN or infinite, and detectors that are none."""
    assert len(subject.cameras)  # as for the contract
    with subject.given() as options:
        parameters = inspect.signature(CAMERAS.get(subject.name)).parameters
        numbers = {
            name: each.default
            for name, each in parameters.items()
            if isinstance(each.default, float)
        }
        numbers |= {name: value for name, value in options.items() if isinstance(value, float)}
        changes = {f"{name} {bad}": {name: bad} for name in numbers for bad in (math.nan, math.inf)}
        if isinstance(detector := options.get("detector"), dict):
            changes |= {
                f"{name} {bad}": {"detector": {**detector, name: bad}} for name, bad in NO_DETECTORS
            }
        if not changes:
            raise DoesNotApply("none of its options is a length or an angle")
        build: Callable[..., Any] = partial(subject.build, **options)
        return none_of(
            {what: refusal(partial(build, **bad), what.split()[0]) for what, bad in changes.items()}
        )


NO_DETECTORS = [
    *[("pixel_mm", bad) for bad in (0.0, -1.0, [1.0, 0.0], math.nan, math.inf)],
    *[("pixels", bad) for bad in (0, -3, [4, 0], 2.5, math.nan)],
    *[("offset_mm", bad) for bad in (math.nan, [0.0, math.inf])],
]

CASES = (
    Case(
        10,
        "points without an image",
        "NaN and not valid, and all others as they are",
        "camera",
        without_image,
    ),
    Case(
        10, "gradients at points without an image", "all are finite", "camera", slopes_without_image
    ),
    Case(
        11,
        "towards the source",
        "the Jacobian is finite and grows",
        "camera",
        towards_the_source,
        dtypes=EXACT,
    ),
    Case(
        11,
        "a source in the volume",
        "lifts and warps are finite",
        "camera",
        source_in_the_volume,
        dtypes=EXACT,
    ),
    Case(
        12,
        "cameras of any size",
        "the same pixels, depths to scale",
        "camera",
        of_any_size,
        1e-12,
        EXACT,
    ),
    Case(13, "cameras far away", "the same pixels and depths", "camera", far_away, 1e-8, EXACT),
    Case(
        21,
        "three cameras, three points",
        "what each gives alone",
        "camera",
        sizes_alike,
        1e-13,
        EXACT,
    ),
    Case(23, "conversions and back", "the same rig", "camera", conversions, 1e-10, EXACT),
    Case(24, "moved by no rigid motion", "refused by name", "camera", bad_motions, dtypes=EXACT),
    Case(24, "moved, and moved back", "the same rig", "camera", moved_back, 1e-13, EXACT),
    Case(48, "options that are no numbers", "refused by name", "camera", bad_options, dtypes=EXACT),
    Case(61, "the contract of a camera", "is kept", "camera", contract, dtypes=EXACT),
)
