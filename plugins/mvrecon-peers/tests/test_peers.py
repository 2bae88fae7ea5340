"""Each library, where it is installed, sees what mvrecon sees: same rays, same voxels, same units,
and its adjoint.
"""

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing import adjoint_gap, gap

CENTRE = torch.tensor([7.0, -5.0, 9.0], dtype=torch.float64)
DETECTOR = {"pixels": [34, 38], "pixel_mm": [1.7, 1.5], "offset_mm": [0.8, -0.6]}
GRID = Grid.centred(size=(29, 27, 26), spacing=(1.1, 0.9, 1.2), centre=CENTRE.tolist())
SQUARE = Grid.centred(size=(29, 27, 21), spacing=(1.1, 1.1, 1.3), centre=CENTRE.tolist())


def tilted(grid: Grid) -> Grid:
    """The same voxels about the same centre, in no direction of the world."""
    R = random_rotation(torch.Generator().manual_seed(3))
    return grid.moved(R, grid.centre - R @ grid.centre)


def about(rig: Cameras, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Cameras:
    """The rig about a point beside the grid's centre."""
    return rig.moved(torch.eye(3), CENTRE + torch.tensor([x, y, z]))


CASES: dict[str, tuple[Grid, Cameras]] = {
    "cone": (GRID, about(circular(4, 70.0, 110.0, DETECTOR, start_degrees=13.0), 1.0, -2.0, 3.0)),
    "dome": (
        tilted(GRID),
        dome(4, 70.0, 110.0, 150.0, DETECTOR, target=CENTRE.tolist(), extent="segment"),
    ),
    "pinholes": (GRID, dome(4, 70.0, 40.0, 150.0, DETECTOR, target=CENTRE.tolist())),
    "beam": (tilted(GRID), about(parallel(4, DETECTOR, 90.0, start_degrees=11.0), 1.0, -2.0, 3.0)),
    "scan": (GRID, about(circular(5, 70.0, 110.0, DETECTOR, start_degrees=13.0), z=2.0)),
    "stack": (
        SQUARE,
        about(
            parallel(5, {"pixels": [23, 35], "pixel_mm": [1.3, 1.1], "offset_mm": [0, 2.2]}, 90.0)
        ),
    ),
    "fan": (
        SQUARE,
        about(
            circular(5, 70.0, 110.0, DETECTOR | {"pixels": [1, 38], "offset_mm": [0, 0.7]}), z=2.6
        ),
    ),
}
ANY = ("cone", "dome", "pinholes", "beam", "scan", "stack")
#: Peer: what it imports, its options, the cases that it takes, our method, and how far from it the
#: peer may be.
PEERS = {
    "rtk": ("itk.RTK", {}, ANY, "joseph", 1e-4),
    "nanodrr": ("nanodrr", {}, ANY, "joseph", 0.012),
    "diffdrr": ("diffdrr", {}, ANY, "siddon", 1e-5),
    "diffdrr trilinear": ("diffdrr", {"method": "trilinear", "samples": 200}, ANY, "joseph", 0.012),
    "astra": ("astra", {}, ("stack", "fan"), "siddon", 1e-5),
    "astra linear": ("astra", {"method": "linear"}, ("stack",), "joseph", 1e-5),
    "astra strip": ("astra", {"method": "strip"}, ("stack",), "joseph", 0.012),
    "mbirtorch": ("mbirtorch", {"compile_mode": "off"}, ("scan", "stack", "fan"), "joseph", 0.012),
    "skimage": ("skimage", {}, ("stack",), "joseph", 0.012),
}
PAIRS = [(peer, case) for peer, (_, _, cases, _, _) in PEERS.items() for case in cases]
#: Of the exact integrals; the voxels' own error.
TOLERANCE = 0.085


def phantom() -> Phantom:
    """Three ellipsoids without any symmetry, off the grid's centre."""
    centres = (
        torch.tensor([[-3.0, 3.0, -3.0], [4.0, -3.0, 3.0], [1.0, 5.0, 6.0]], dtype=torch.float64)
        + CENTRE
    )
    semi_axes = torch.tensor(
        [[8.0, 5.0, 6.0], [6.0, 8.0, 5.0], [6.0, 4.0, 5.0]], dtype=torch.float64
    )
    return Phantom(
        (
            Solids(
                "ellipsoid",
                centres,
                random_rotation(torch.Generator().manual_seed(1), 3),
                semi_axes,
                torch.ones(3),
            ),
        )
    )


@cache
def seen(case: str) -> tuple[Tensor, Tensor]:
    """The phantom's voxels and its exact views."""
    grid, rig = CASES[case]
    return voxelise(phantom(), grid)[None, None], phantom().integrals(
        *rig.rays(), ray_extent=rig.ray_extent
    )[None, None]


def build(peer: str, case: str, **change):
    """A peer on a case, or a skip where its library is absent."""
    library, options, *_ = PEERS[peer]
    if library == "itk.RTK":
        pytest.importorskip("itk", exc_type=ImportError)
    pytest.importorskip(library.partition(".")[0], exc_type=ImportError)
    grid, rig = CASES[case]
    return PROJECTORS.build(peer.split()[0], **({"grid": grid, "cameras": rig} | options | change))


def ours(case: str, method: str):
    grid, rig = CASES[case]
    return RayTransform(grid, rig, method=method)


@pytest.mark.parametrize(("peer", "case"), PAIRS)
def test_peers_match_exact_integrals_and_our_projectors(peer: str, case: str):
    A, (x, exact) = build(peer, case), seen(case)
    views = A(x)
    assert views.shape == exact.shape
    assert gap(views, exact) < TOLERANCE
    _, _, _, method, far = PEERS[peer]
    assert gap(views, ours(case, method)(x)) < far


@pytest.mark.parametrize("case", CASES)
def test_half_a_voxel_or_pixel_a_flip_or_a_turn_would_exceed_the_tolerance(case: str):
    """What our own operator, put wrong in any such way, sees of the phantom."""
    A, (x, exact) = ours(case, "joseph"), seen(case)
    right = A(x)
    grid, rig = CASES[case]
    changed = {f"flipped {axis}": A(x.flip(axis)) for axis in (2, 3, 4)}
    changed |= {
        f"views flipped {axis}": right.flip(axis) for axis in (2, 3, 4) if right.shape[axis] > 1
    }
    for axis in range(3):
        affine = grid.affine.clone()
        affine[:3, 3] += grid.affine[:3, axis] / 2
        if case != "fan" or axis < 2:  # a fan sees one slice
            name = "radon" if rig.parallel else "drr"
            changed[f"half a voxel {axis}"] = PROJECTORS.build(
                name, grid=Grid(grid.shape, affine), cameras=rig
            )(x)
    for axis, steps in ((-1, (0.5, 0)), (-2, (0, 0.5))):
        if right.shape[axis] > 1:
            shift = rig.u * steps[0] + rig.v * steps[1]
            moved = replace(
                rig, origin=rig.origin + shift, source=rig.source + (shift if rig.parallel else 0)
            )
            changed[f"half a pixel {axis}"] = phantom().integrals(
                *moved.rays(), ray_extent=rig.ray_extent
            )[None, None]
    for name, views in changed.items():
        assert gap(views, exact) > TOLERANCE, name
    assert gap(right, exact) < TOLERANCE


@pytest.mark.parametrize(("peer", "case"), [pair for pair in PAIRS if pair[0] != "skimage"])
def test_the_adjoint_matches(peer: str, case: str):
    A = build(peer, case)
    torch.manual_seed(0)
    x, y = torch.rand(1, 1, *A.grid.shape), torch.rand(1, 1, len(A.cameras), *A.cameras.shape)
    assert adjoint_gap(A, x, y) < 1e-5


def test_the_back_projection_of_skimage_approximates_the_adjoint():
    A, (_, exact) = build("skimage", "stack"), seen("stack")
    assert gap(A.T(exact), ours("stack", "joseph").T(exact)) < 0.05


@pytest.mark.parametrize("peer", PEERS)
def test_gradients_equal_the_adjoint_for_batches_channels_and_dtypes(peer: str):
    case = PEERS[peer][2][-1]
    A, torch_seed = build(peer, case), torch.Generator().manual_seed(0)
    x = torch.rand(2, 2, *A.grid.shape, generator=torch_seed, requires_grad=True)
    views = A(x)
    assert torch.equal(views[1:, 1:], A(x[1:, 1:]))
    y = torch.rand(views.shape, generator=torch_seed)
    (gradient,) = torch.autograd.grad(views, x, y)
    assert gap(gradient, A.T(y)) < 1e-6
    y.requires_grad_()
    (second,) = torch.autograd.grad(A.T(y).square().sum(), y)
    assert gap(second, 2 * A(A.T(y.detach()))) < 1e-5
    half = A(x.detach().half())
    assert half.dtype == torch.float32
    assert gap(half, views.detach()) < 1e-3
    if torch.float64 in A.precisions:
        double = A(x.detach().double())
        assert double.dtype == torch.float64
        assert gap(double.float(), views.detach()) < 1e-5


@pytest.mark.parametrize("peer", PEERS)
def test_unsupported_dtypes_are_refused(peer: str):
    A = build(peer, PEERS[peer][2][-1])
    x = torch.rand(1, 1, *A.grid.shape)
    tensors: list[Any] = [x.int(), x.bool(), torch.complex(x, x)]
    tensors += [] if torch.float64 in A.precisions else [x.double()]
    for tensor in tensors:
        with pytest.raises(ValueError, match=str(tensor.dtype)):
            A(tensor)
    with pytest.raises(TypeError, match="ndarray"):
        A(x.numpy())


@pytest.mark.parametrize("peer", PEERS)
def test_every_peer_is_a_torch_operator(peer: str):
    """Empty batches, vmap, forward mode, autocast, and lifetime until backward."""
    A = build(peer, PEERS[peer][2][-1])
    x = torch.rand(3, 1, 1, *A.grid.shape, requires_grad=True)
    assert A(x[:0, 0]).shape == (0, 1, len(A.cameras), *A.cameras.shape)
    views = torch.stack([A(one) for one in x])
    assert torch.equal(torch.func.vmap(A)(x), views)
    assert torch.equal(torch.func.jvp(A, (x[0],), (x[1],))[1], views[1])
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(A(x[0]), views[0])
    weight, expected = torch.rand(views[0].shape), A.T(torch.ones_like(views[0]))
    (gradient,) = torch.autograd.grad(build(peer, PEERS[peer][2][-1])(x[0]).sum(), x)
    assert torch.equal(gradient[0], expected)
    assert torch.equal(
        copy.deepcopy(A).T(weight) if peer in ("nanodrr", "diffdrr") else A.T(weight), A.T(weight)
    )


@pytest.mark.parametrize("peer", ["rtk", "diffdrr", "nanodrr"])
@pytest.mark.parametrize("size", [(1, 1, 1), (7, 1, 1), (1, 1, 5), (4, 5, 6)])
def test_single_pixel_detectors_measure_the_chord_of_a_box_of_ones(
    peer: str, size: tuple[int, int, int]
):
    """Rays through a box's middle, along and across: no half voxel is lost at the faces, and no
    view is for another.
    """
    way = torch.cat(
        [torch.eye(3), -torch.eye(3), torch.tensor([[1.0, 0.03, 0.0], [0.0, 1.0, -0.03]])]
    ).double()
    way = way if peer == "diffdrr" else way[:6]  # kernels that interpolate fade to the sides, too
    right = torch.nn.functional.normalize(
        torch.linalg.cross(way, way.roll(1, dims=1) + 0.1), dim=-1
    )
    down = torch.nn.functional.normalize(torch.linalg.cross(way, right), dim=-1)
    grid = Grid.centred(size=size[::-1], spacing=(1.0, 1.2, 0.9), centre=CENTRE.tolist())
    rig = Cameras(grid.centre - 20 * way, grid.centre + 20 * way, right, down, (1, 1))
    options = {"samples": 500} if peer == "nanodrr" else {}
    views = build(peer, "cone", grid=grid, cameras=rig, **options)(torch.ones(1, 1, *size))
    lengths = torch.tensor(grid.shape[::-1]) * torch.tensor(grid.spacing)
    chord = lengths[way.abs().argmax(dim=1)] * (way.norm(dim=1) / way.abs().amax(dim=1))
    assert torch.allclose(views.flatten().double(), chord, rtol=4e-3 if peer == "nanodrr" else 1e-5)


@pytest.mark.parametrize("peer", ["nanodrr", "diffdrr trilinear"])
def test_pose_gradients_equal_finite_differences(peer: str):
    grid, rig = CASES["dome"]
    x = seen("dome")[0].double()
    rig, (way,) = (
        rig[:2],
        torch.randn(1, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
    )
    weight = torch.linspace(0, 1, rig.shape[1], dtype=torch.float64)

    def value(step: Tensor) -> Tensor:
        moved = replace(rig, source=rig.source + step * way)
        return (build(peer, "dome", cameras=moved)(x) * weight).sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(step), step)
    with torch.no_grad():
        difference = (value(step + 1e-4) - value(step - 1e-4)) / 2e-4
    assert gradient.item() == pytest.approx(difference.item(), rel=0.02)


def test_siddon_of_diffdrr_has_finite_gradients_in_every_camera_vector():
    _, rig = CASES["cone"]
    vectors = {name: getattr(rig, name).clone().requires_grad_() for name in VECTORS}
    views = build("diffdrr", "cone", cameras=replace(rig, **vectors))(seen("cone")[0])
    for gradient in torch.autograd.grad(views.sum(), list(vectors.values())):
        assert gradient.isfinite().all() and gradient.any()
