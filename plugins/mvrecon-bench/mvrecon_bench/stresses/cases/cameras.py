"""Cameras: distant positions, all sizes, rigid motions, conversions, and rejected options."""

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras import convert
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.files import from_file, save
from mvrecon.geometry.rigid import inverse, random_rotation
from mvrecon.testing import check_camera
from mvrecon.testing.measures import gap, greatest
from mvrecon_bench.stresses.camera_subject import CameraSubject
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.refusals import none_of, refusal

#: Geometry is computed in float64 for any dtype of volumes and views.
EXACT = (torch.float64,)


def contract(subject: CameraSubject) -> float:
    """`mvrecon.testing.check_camera`."""
    assert len(subject.cameras)  # raises DoesNotApply if it cannot be built
    with subject.given() as options:
        check_camera(subject.name, **options)
    return 0.0


def sizes_alike(subject: CameraSubject) -> float:
    """Three cameras, three points, three coordinates: individual results equal the batched ones."""
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
        images = torch.stack(
            [moved.project(x @ R.T + t)[m] for m, x in enumerate(rig.unproject(uvz))]
        )
        errors.append(float(((images - uvz).abs() / (1 + uvz.abs())).max()))
    return greatest(errors)


def of_any_size(subject: CameraSubject) -> float:
    """Cameras and points scaled together, down to pixels of 1e-9 and up to 1e9 mm: the same pixels,
    depths to scale.
    """
    rig, uvz = subject.few, subject.somewhere()
    xyz, errors = rig.unproject(uvz), []
    for scale in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        other = replace(rig, **{name: scale * getattr(rig, name) for name in VECTORS})
        images = torch.stack([other.project(scale * x)[m] for m, x in enumerate(xyz)])
        errors += [gap(other.distance, scale * rig.distance), gap(images[..., :2], uvz[..., :2])]
        errors.append(gap(images[..., 2], scale * uvz[..., 2]))
    return greatest(errors)


def moved_back(subject: CameraSubject) -> float:
    """A rigid motion and its inverse leave the rig unchanged."""
    rig, R = subject.few, random_rotation(torch.Generator().manual_seed(6)).to(subject.few.source)
    t = rig.source.new_tensor([30.0, -50.0, 70.0])
    return rig_error(rig.moved(R, t).moved(*inverse(R, t)), rig)


def bad_motions(subject: CameraSubject) -> float:
    """The rig is moved by a non-rigid motion."""
    R, t = random_rotation(torch.Generator().manual_seed(7)), torch.zeros(3)
    bad = {name: (change(R), t) for name, change in NO_ROTATIONS.items()}
    refusals = {
        name: refusal(partial(subject.few.moved, *motion), "(?i)rotation")
        for name, motion in bad.items()
    }
    return none_of(
        refusals | {"t is NaN": refusal(partial(subject.few.moved, R, t * math.nan), "translation")}
    )


#: Perturbations that make a matrix invalid as a rotation.
NO_ROTATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "a mirror": lambda R: R * R.new_tensor([1.0, 1.0, -1.0]),
    "scaled by 1.001": lambda R: R * 1.001,
    "sheared by 1e-3": lambda R: R @ (torch.eye(3).to(R) + 1e-3 * torch.eye(3).to(R).roll(1, 0)),
    "nought": lambda R: R * 0,
    "NaN": lambda R: R * math.nan,
}


def conversions(subject: CameraSubject) -> float:
    """Conversion to the conventions of other libraries, to a file, and back: the same rig."""
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
    pairs = [(getattr(rig, name), getattr(expected, name)) for name in VECTORS]
    return greatest(gap(a, b) for a, b in pairs)


def bad_options(subject: CameraSubject) -> float:
    """NaN and infinite options, and invalid detectors."""
    assert len(subject.cameras)  # as in the contract
    with subject.given() as options:
        parameters = inspect.signature(CAMERAS.get(subject.name)).parameters
        numbers = {
            name: parameter.default
            for name, parameter in parameters.items()
            if isinstance(parameter.default, float)
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
        12,
        "cameras of any size",
        "the same pixels, scaled depths",
        "camera",
        of_any_size,
        1e-12,
        EXACT,
    ),
    Case(13, "cameras far away", "the same pixels and depths", "camera", far_away, 1e-8, EXACT),
    Case(
        21,
        "three cameras, three points",
        "each as on its own",
        "camera",
        sizes_alike,
        1e-13,
        EXACT,
    ),
    Case(23, "conversions and back", "the same rig", "camera", conversions, 1e-10, EXACT),
    Case(
        24,
        "motions that are not rigid",
        "an error that names it",
        "camera",
        bad_motions,
        dtypes=EXACT,
    ),
    Case(24, "moved, and moved back", "the same rig", "camera", moved_back, 1e-13, EXACT),
    Case(
        48,
        "options that are not numbers",
        "an error that names it",
        "camera",
        bad_options,
        dtypes=EXACT,
    ),
    Case(61, "check_camera", "passes", "camera", contract, dtypes=EXACT),
)
