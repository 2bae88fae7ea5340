"""Poses and intrinsics: special rotations, nearly singular matrices, and input validation."""

import math
import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mvrecon.geometry.cameras import convert
from mvrecon.geometry.cameras.camera import VECTORS, Cameras, ExplicitRays
from mvrecon.geometry.cameras.rigs import Detector, circular
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import euler_rotation, inverse, look_at, random_rotation
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.cameras import EXACT, NO_ROTATIONS
from mvrecon_bench.stresses.refusals import none_of, refusal
from mvrecon_bench.stresses.subject import DETECTOR, Subject

EPS = torch.finfo(torch.float64).eps


def improper(R: Tensor) -> float:
    """Distance of matrices from rotations: the largest entry of R R^T - 1 and det R - 1."""
    off = (R @ R.mT - torch.eye(3).to(R)).abs().amax()
    return float(torch.maximum(off, (torch.linalg.det(R) - 1).abs().amax()))


def up_along_the_view(_: Subject) -> float:
    """Cameras whose up vector is (nearly) parallel to the viewing direction, and their
    gradients.
    """
    errors, tilts = [], (0.0, 1e-300, 1e-12, 1e-9, 1e-8, 2e-8, 1e-7, 1e-6, 1e-3)
    for up in ((0.0, 0.0, 1.0), (0.0, 1e-200, 0.0), (1.0, 2.0, -3.0), (0.0, 0.0, 0.0)):
        axis = torch.tensor(up, dtype=torch.float64)
        along = torch.nn.functional.normalize(axis if axis.norm() > 0 else axis + 1, dim=0)
        aside = torch.linalg.cross(along, torch.eye(3, dtype=torch.float64)[along.abs().argmin()])
        target = torch.stack(
            [70 * (s * along + tilt * aside) for tilt in tilts for s in (1, -1)]
        ).requires_grad_()
        R = look_at(torch.zeros_like(target), target, up)
        (slope,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), target)
        assert slope.isfinite().all(), f"gradients of look_at are not finite for up = {up}"
        errors.append(improper(R.detach()))
    return greatest(errors)


def looking_at_itself(_: Subject) -> float:
    """A camera at its target, or at a NaN position."""
    eye = torch.tensor([3.0, -2.0, 1.0])
    bad = {"at its target": eye, "NaN": eye * math.nan, "infinitely far": eye * math.inf}
    failures = {
        name: refusal(partial(look_at, eye, target), "must not be at|finite")
        for name, target in bad.items()
    }
    return none_of(
        failures | {"up is NaN": refusal(partial(look_at, eye, -eye, (0.0, math.nan, 1.0)), "up")}
    )


def intrinsics() -> Iterator[tuple[str, Tensor]]:
    """Camera matrices that become increasingly singular in different ways."""
    for power in range(17):
        c = 10.0**power
        yield f"fx = 1/{c:.0e}", torch.tensor([[1 / c, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        yield f"fx = {c:.0e}", torch.tensor([[c, 0.0, 12.0], [0.0, c, 7.0], [0.0, 0.0, 1.0]])
        yield f"skew {c:.0e}", torch.tensor([[100.0, c, 12.0], [0.0, 100.0, 7.0], [0.0, 0.0, 1.0]])
        yield f"cx = {c:.0e}", torch.tensor([[100.0, 0.0, c], [0.0, 100.0, 7.0], [0.0, 0.0, 1.0]])


def nearly_singular(_: Subject) -> float:
    """K, R, t to cameras and back, in units of eps cond(K), unless rejected with the condition
    number.
    """
    R, t = (
        random_rotation(torch.Generator().manual_seed(2))[None],
        torch.tensor([[3.0, -2.0, 50.0]]).double(),
    )
    errors = []
    for name, K in intrinsics():
        K, cond = K.double()[None], float(torch.linalg.cond(K.double()))
        try:
            krt = convert.to_krt(convert.from_krt(K, R, t, (6, 5), 80.0))
        except ValueError as error:
            assert re.search(r"(determinant|condition)\D*\d", str(error)), f"{name}: {error}"
            assert cond > 1e6, f"{name}, of condition {cond:.0e}, is refused: {error}"
            continue
        errors += [gap(a, b) / (EPS * cond) for a, b in zip(krt, (K, R, t), strict=True)]
    return greatest(errors)


def no_rotations(_: Subject) -> float:
    """Invalid rotations in K, R, t and in kornia's extrinsics."""
    K, R, t = convert.to_krt(circular(2, 40.0, 70.0, DETECTOR))
    failures = {}
    for name, change in NO_ROTATIONS.items():
        bad = torch.stack([R[0], change(R[1])])
        failures[f"K R t: {name}"] = refusal(
            partial(convert.from_krt, K, bad, t, (6, 5), 70.0), "R must be"
        )
        extrinsics = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        extrinsics[:, :3, :3] = bad
        four = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        four[:, :3, :3] = K
        failures[f"kornia: {name}"] = refusal(
            partial(convert.from_kornia, four, extrinsics, (6, 5), 70.0), "must be"
        )
    return none_of(failures)


def special_rotations(_: Subject) -> float:
    """Euler angles at and near 0, 90 and 180 degrees: valid rotations, inverted by negated angles,
    with finite gradients.
    """
    close = [x + tiny for x in (0.0, 37.0, 90.0, 180.0) for tiny in (0.0, 1e-300, -1e-7, 1e-7)]
    errors = []
    for axes in ("zyz", "xyz", "zxx"):
        angles = torch.cartesian_prod(
            *[torch.tensor(close, dtype=torch.float64)] * 3
        ).requires_grad_()
        R = euler_rotation(angles, axes)
        (slope,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), angles)
        assert slope.isfinite().all(), f"gradients of Euler angles {axes} are not finite"
        undone = R.detach() @ euler_rotation(-angles.detach().flip(-1), axes[::-1])
        errors += [improper(R.detach()), float((undone - torch.eye(3).to(undone)).abs().amax())]
    return greatest(errors)


def quaternions(_: Subject) -> float:
    """q and -q describe the same rotation, also near angles of 0 and 180 degrees."""
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    near = [
        torch.eye(4, dtype=torch.float64)[k] + tiny
        for k in range(4)
        for tiny in (0.0, 1e-300, 1e-9)
    ]
    q = torch.cat(
        [torch.stack(near), torch.randn(8, 4, generator=torch.Generator().manual_seed(3)).double()]
    )
    q = q.requires_grad_()
    R = quaternion_to_rotation_matrix(q)
    (slope,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), q)
    assert slope.isfinite().all(), "gradients of quaternions are not finite"
    return greatest(
        [improper(R.detach()), float((R - quaternion_to_rotation_matrix(-q)).abs().amax())]
    )


def undone(_: Subject) -> float:
    """A rigid motion composed with its inverse is the identity."""
    R = random_rotation(torch.Generator().manual_seed(8), 20)
    t = 1e3 * torch.randn(20, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    back, shift = inverse(R, t)
    rest = (back @ t[..., None])[..., 0] + shift
    return greatest(
        [
            float((back @ R - torch.eye(3).to(R)).abs().amax()),
            float(rest.abs().amax() / t.abs().amax()),
        ]
    )


def bad_geometry(_: Subject) -> float:
    """NaN and infinite numbers in each field of grids, records, detectors, matrices and rays."""
    failures = {}
    rig = circular(2, 40.0, 70.0, DETECTOR)
    K, R, t = convert.to_krt(rig)
    affine = torch.eye(4, dtype=torch.float64)
    start, end = rig.rays()
    for bad in (math.nan, math.inf, -math.inf):
        acts = {
            "spacing": partial(Grid.centred, (4, 4, 4), (1.0, bad, 1.0)),
            "centre": partial(Grid.centred, (4, 4, 4), 1.0, (0.0, bad, 0.0)),
            "affine": partial(Grid, (4, 4, 4), _spoilt(affine, bad)),
            "pixel_mm": partial(Detector, (4, 4), (1.0, bad)),
            "offset_mm": partial(Detector, (4, 4), (1.0, 1.0), (bad, 0.0)),
            "K": partial(convert.from_krt, _spoilt(K, bad), R, t, (6, 5), 70.0),
            "R": partial(convert.from_krt, K, _spoilt(R, bad), t, (6, 5), 70.0),
            "t": partial(convert.from_krt, K, R, _spoilt(t, bad), (6, 5), 70.0),
            "distance": partial(convert.from_krt, K, R, t, (6, 5), bad),
            "P": partial(convert.from_matrix, _spoilt(rig.matrix, bad), (6, 5), 70.0),
            "ASTRA": partial(convert.from_astra, _spoilt(convert.to_astra(rig), bad), (6, 5)),
            "target": partial(ExplicitRays, start, _spoilt(end, bad)),
        }
        for name in VECTORS:
            acts[f"{name} "] = partial(_record, rig, **{name: _spoilt(getattr(rig, name), bad)})
        failures |= {
            f"{name} {bad}": refusal(act, rf"\b{name.strip()}\b") for name, act in acts.items()
        }
    return none_of(failures)


def flat_and_left_handed(_: Subject) -> float:
    """Records and grids with reversed or missing axes, and detectors without pixels."""
    rig, affine = circular(2, 40.0, 70.0, DETECTOR), torch.eye(4, dtype=torch.float64)
    return none_of(
        {
            "u reversed": refusal(partial(_record, rig, u=-rig.u), "camera 0 is left-handed"),
            "v reversed": refusal(partial(_record, rig, v=-rig.v), "camera 0 is left-handed"),
            "one reversed": refusal(
                partial(_record, rig, v=rig.v * torch.tensor([[1], [-1]])), "camera 1 is left"
            ),
            "u = 0": refusal(partial(_record, rig, u=rig.u * 0), "flat.*determinant"),
            "v = u": refusal(partial(_record, rig, v=rig.u), "flat.*determinant"),
            "source on the detector": refusal(
                partial(_record, rig, source=rig.origin), "flat.*determinant"
            ),
            "no rows": refusal(partial(_record, rig, shape=(0, 5)), "shape"),
            "half a column": refusal(partial(_record, rig, shape=(6, 2.5)), "shape"),
            "no cameras": refusal(lambda: rig[[]], "one row a camera"),
            "a mirrored grid": refusal(
                partial(Grid, (4, 4, 4), -affine), "right-handed.*determinant"
            ),
            "a flat grid": refusal(
                partial(Grid, (4, 4, 4), affine.roll(1, 0).triu()), "determinant|affine"
            ),
            "no voxels": refusal(partial(Grid, (4, 0, 4), affine), "shape"),
            "a spacing of nought": refusal(
                partial(Grid.centred, (4, 4, 4), (1.0, 0.0, 1.0)), "spacing"
            ),
        }
    )


def _record(rig: Cameras, **change: Any) -> Cameras:
    names = (*VECTORS, "shape", "parallel", "extent")
    fields: dict[str, Any] = {name: getattr(rig, name) for name in names}
    return Cameras(**{**fields, **change})


def _spoilt(tensor: Tensor, bad: float) -> Tensor:
    """A copy whose middle number is bad."""
    copy = tensor.flatten().clone()
    copy[len(copy) // 2] = bad
    return copy.reshape(tensor.shape)


CASES = (
    Case(
        22,
        "up vector along the viewing direction",
        "proper rotations, finite gradients",
        "mvrecon",
        up_along_the_view,
        1e-12,
        EXACT,
    ),
    Case(22, "a camera at its target", "an error", "mvrecon", looking_at_itself, dtypes=EXACT),
    Case(
        23,
        "nearly singular K",
        "the same K, R, t within eps cond(K), or an error",
        "mvrecon",
        nearly_singular,
        10,
        EXACT,
    ),
    Case(
        24,
        "matrices R that are not rotations",
        "an error that names it",
        "mvrecon",
        no_rotations,
        dtypes=EXACT,
    ),
    Case(
        25,
        "rotations by 0 and 180 degrees",
        "proper rotations with inverses",
        "mvrecon",
        special_rotations,
        1e-10,
        EXACT,
    ),
    Case(25, "quaternions q and -q", "the same rotation", "mvrecon", quaternions, 1e-10, EXACT),
    Case(
        25, "the inverse of a motion", "composes to the identity", "mvrecon", undone, 1e-12, EXACT
    ),
    Case(
        48,
        "geometry that is not finite",
        "an error that names it",
        "mvrecon",
        bad_geometry,
        dtypes=EXACT,
    ),
    Case(
        48,
        "flat, left-handed or empty geometry",
        "an error that names it",
        "mvrecon",
        flat_and_left_handed,
        dtypes=EXACT,
    ),
)
