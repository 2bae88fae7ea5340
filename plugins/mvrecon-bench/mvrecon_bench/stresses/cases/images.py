"""Points without an image in the plane of a source or behind it; a source inside the volume."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry import lattice
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.methods.learned.view_frames import Frusta
from mvrecon_bench.stresses.camera_subject import CameraSubject
from mvrecon_bench.stresses.case import Case
from mvrecon_bench.stresses.cases.cameras import EXACT
from mvrecon_bench.stresses.refusals import none_of

#: Depths in mm at and near the plane of the source, and behind it.
NOUGHT = (0.0, -0.0, 1e-12, -1e-12, 1e-8, -1e-8, -7.0)


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


def without_image(subject: CameraSubject) -> float:
    """Projection and validity of points in the plane of the source, behind it, and with NaN
    coordinates.
    """
    failures: dict[str, str] = {}
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
        failures |= {
            f"camera {m}: {what}": str(int(hit.sum())) for what, hit in hits.items() if hit.any()
        }
    return none_of(failures)


def slopes_without_image(subject: CameraSubject) -> float:
    """Gradients of valid images are not affected by points without an image; also for
    unprojection.
    """
    violations = 0
    for rig in subject.few:
        places = about_the_source(rig, subject.side).to(subject.dtype)
        points = torch.cat([places, nowhere(places[-1])]).requires_grad_()
        for back in (False, True):
            vectors = [getattr(rig, name).clone().requires_grad_() for name in VECTORS]
            leaf = replace(rig, **dict(zip(VECTORS, vectors, strict=True)))
            images = leaf.unproject(points[None]) if back else leaf.project(points)
            used = images.isfinite().all(dim=-1) if back else leaf.valid(images)
            gradients = torch.autograd.grad(
                torch.where(used[..., None], images, 0.0).sum(), (points, *vectors)
            )
            violations += sum(int((~gradient.isfinite()).sum()) for gradient in gradients)
    return violations


def frustum_jacobian(
    cameras: Cameras, xyz: Float[Tensor, "*n 3"], f: float = 1.0
) -> Float[Tensor, "m *n"]:
    """Volume in (u, v, k) per mm^3 at world points, |det H| / w^4; a count-preserving density is
    divided by it.
    """
    H = lattice.to_frustum(cameras, f)
    w = H[:, 3, :3] @ xyz.reshape(-1, 3).to(H).T + H[:, 3, 3:]
    return (torch.linalg.det(H).abs()[:, None] / w**4).reshape(len(cameras), *xyz.shape[:-1])


def towards_the_source(subject: CameraSubject) -> float:
    """The frustum's Jacobian, |det H| / w^4, from 1000 mm towards the source."""
    rig = subject.few
    uv = rig.source.new_tensor([(n - 1) / 2 for n in rig.shape[::-1]]).expand(len(rig), 13, 2)
    z = subject.side * torch.logspace(3, -9, 13, dtype=torch.float64, device=rig.source.device)
    xyz = rig.unproject(torch.cat([uv, z.expand(len(rig), 13)[..., None]], dim=-1))
    jacobian = torch.stack([frustum_jacobian(rig, xyz[m])[m] for m in range(len(rig))])
    return float((~jacobian.isfinite()).sum() + (jacobian.diff(dim=1) < 0).sum())


def source_in_the_volume(subject: CameraSubject) -> float:
    """Lifts and warps of frusta whose source is at the centre of the grid."""
    rig = subject.few
    step = float(rig.distance[0]) / 10
    frusta = Frusta.of(
        Grid.centred(size=(6, 5, 4), spacing=step, centre=rig.source[0].tolist()), rig, depth=6
    ).to(rig.source.device)
    views = torch.ones(1, 1, len(rig), *rig.shape, device=rig.source.device, requires_grad=True)
    lifted = frusta.spread(views)
    world = frusta.to_volume(lifted)
    back = frusta.to_frusta(world)
    (slope,) = torch.autograd.grad(back.sum(), views)
    return float(sum((~tensor.isfinite()).sum() for tensor in (lifted, world, back, slope)))


CASES = (
    Case(
        10,
        "points without an image",
        "NaN and invalid; other points unchanged",
        "camera",
        without_image,
    ),
    Case(10, "gradients at points without an image", "finite", "camera", slopes_without_image),
    Case(
        11,
        "points close to the source",
        "the Jacobian stays finite and increases",
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
)
