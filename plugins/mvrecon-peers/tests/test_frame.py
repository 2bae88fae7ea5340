"""Rigs in the volume's frame, and what libraries cannot take: pure geometry, no library needed."""

from dataclasses import replace

import pytest
import torch

from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon_peers.astra import Astra
from mvrecon_peers.diffdrr import Diffdrr
from mvrecon_peers.frame import chords, framed, near, plane_of_rows
from mvrecon_peers.mbirtorch import Mbirtorch, rig_of, scan_of
from mvrecon_peers.nanodrr import Nanodrr
from mvrecon_peers.rtk import Rtk, view_arguments
from mvrecon_peers.skimage import Skimage, turns

GRID = Grid.centred(size=(14, 12, 10), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
DETECTOR = {"pixels": [5, 7], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
CONE = circular(4, 40.0, 70.0, DETECTOR, start_degrees=13.0).moved(torch.eye(3), GRID.centre)
NORMAL = torch.linalg.cross(CONE.u, CONE.v)
BEAM = parallel(4, DETECTOR, 60.0, start_degrees=11.0).moved(torch.eye(3), GRID.centre)
PINHOLES = dome(4, 30.0, 20.0, 120.0, DETECTOR, target=GRID.centre.tolist())
RIGS = {
    "cone": CONE,
    "ahead": replace(CONE, extent="ahead"),
    "pinholes": PINHOLES,
    "dcspect80": dcspect80(48).moved(torch.eye(3), GRID.centre),
    "beam": BEAM,
    "line": replace(BEAM, extent="line"),
    "half lines": replace(BEAM, extent="ahead"),
}


@pytest.mark.parametrize("kind", RIGS)
@pytest.mark.parametrize("tilt", [False, True])
def test_a_framed_rig_measures_the_same_integrals(kind: str, tilt: bool):
    grid, rig = GRID, RIGS[kind]
    R = (
        random_rotation(torch.Generator().manual_seed(0))
        if tilt
        else torch.eye(3, dtype=torch.float64)
    )
    box, inner = framed(grid.moved(R, torch.zeros(3)), rig.moved(R, torch.zeros(3)))
    assert inner.extent == "segment"
    centres = torch.tensor([[1.0, 2.0, -1.0], [-2.0, 0.5, 2.0]], dtype=torch.float64)
    turn = random_rotation(torch.Generator().manual_seed(1), 2)
    inside = Phantom(
        (Solids("ellipsoid", centres, turn, torch.tensor([[2.0, 3, 1], [1, 2, 2]]), torch.ones(2)),)
    )
    framed_integrals = inside.integrals(*inner.rays(), ray_extent=inner.ray_extent)
    world = inside.moved(torch.eye(3), GRID.centre).integrals(
        *rig.rays(), ray_extent=rig.ray_extent
    )
    assert framed_integrals.any()
    assert torch.allclose(framed_integrals, world, atol=1e-9)
    assert torch.allclose(box.centre, torch.zeros(3, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("kind", ["ahead", "pinholes", "dcspect80"])
def test_detectors_moved_beyond_the_box_keep_one_pixel_size_and_clear_the_kernel(kind: str):
    box, rig = framed(GRID, RIGS[kind])
    pitch = rig.u.norm(dim=-1)
    assert torch.allclose(pitch, pitch[0])
    assert (rig.depth_range(box)[:, 1] + min(box.spacing) < rig.distance).all()


def test_framing_is_differentiable_in_the_cameras():
    source = PINHOLES.source.clone().requires_grad_()
    _, rig = framed(GRID, replace(PINHOLES, source=source))
    assert torch.autograd.grad(torch.stack(rig.rays()).square().sum(), source)[0].any()


@pytest.mark.parametrize("kind", ["cone", "tilted", "along y", "beam"])
def test_rtk_parameters_reproduce_the_rays(kind: str):
    turn = {
        "tilted": random_rotation(torch.Generator().manual_seed(0)),
        "along y": turned(90.0, 0) @ turned(-13.0, 2),
    }
    R, rig = turn.get(kind, turned(0.0, 0)), CONE.moved(torch.eye(3), -GRID.centre)
    if kind == "beam":
        rig = parallel(4, DETECTOR, 60.0, start_degrees=25.0, arc_degrees=360.0)
    box, rig = framed(GRID, rig.moved(R, GRID.centre))
    start, end = rig.rays()
    for m, (sid, sdd, gantry, right, down, out, inner, x, y) in enumerate(view_arguments(box, rig)):
        degrees = (torch.tensor(angle).rad2deg().item() for angle in (-inner, -out, -gantry))
        axes = torch.eye(3, dtype=torch.float64)
        for angle, axis in zip(degrees, (2, 0, 1), strict=True):
            axes = axes @ turned(angle, axis)
        assert torch.allclose(axes[0] * 2.3, rig.u[m], atol=1e-12)
        assert torch.allclose(axes[1] * 2.1, rig.v[m], atol=1e-12)
        middle = torch.tensor([right, down, sid - sdd], dtype=torch.float64) @ axes
        if kind == "beam":
            assert sdd == 0
            along = torch.linalg.cross(end[m, 2, 3] - start[m, 2, 3], axes[2])
            assert along.abs().max() < 1e-9
            assert torch.allclose(
                (middle - end[m, 2, 3]) @ axes[:2].T,
                torch.zeros(2, dtype=torch.float64),
                atol=1e-12,
            )
        else:
            assert torch.allclose(middle, end[m, 2, 3], atol=1e-12)
            assert torch.allclose(
                torch.tensor([x, y, sid], dtype=torch.float64) @ axes, rig.source[m], atol=1e-12
            )


def test_rays_are_truncated_near_the_box_along_their_lines():
    box, rng = (
        Grid.centred(size=(6, 5, 4), spacing=(1.0, 1.2, 0.9)),
        torch.Generator().manual_seed(0),
    )
    first, way = torch.rand(2, 200, 3, generator=rng, dtype=torch.float64) * 12 - 6
    first[:20], way[:60:7, 0] = 0.0, 0.0
    last = first + 1e5 * way
    enter, leave = chords(box, first, last)
    start, end = near(box, first, last)
    again = chords(box, start, end)
    hit = (enter < leave) & (leave > 0)
    assert hit.any() and not hit.all()
    assert start.abs().max() < 30 and end.abs().max() < 30
    for fraction, part in zip(
        (enter.clamp(min=0), leave), (again[0].clamp(min=0), again[1]), strict=True
    ):
        point, expected = (
            start + part[:, None] * (end - start),
            first + fraction[:, None] * (last - first),
        )
        assert torch.allclose(point[hit], expected[hit], atol=1e-9)
    misses = (again[0] >= again[1]) | (again[1] <= 1e-9)
    assert torch.equal(misses, ~hit)


def turned(degrees: float, axis: int) -> torch.Tensor:
    """The rotation about an axis, counter-clockwise."""
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    generator = torch.zeros(3, 3, dtype=torch.float64)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    generator[b, a], generator[a, b] = angle, -angle
    return torch.linalg.matrix_exp(generator)


@pytest.mark.parametrize("upright", [False, True])
def test_mbirtorch_parameters_reproduce_the_rig(upright: bool):
    flip = (
        replace(CONE, origin=CONE.origin + 4 * CONE.v + 6 * CONE.u, u=-CONE.u, v=-CONE.v)
        if upright
        else CONE
    )
    heights = torch.linspace(0, 3, 4, dtype=torch.float64)[:, None] * torch.tensor([0, 0, 1.0])
    helix = replace(flip, source=flip.source + heights, origin=flip.origin + heights)
    _, rig = framed(GRID, helix)
    scan = scan_of(rig)
    assert scan.turned is not upright
    assert (round(scan.sid, 9), round(scan.sdd, 9)) == (40.0, 70.0)
    again = rig_of(scan, rig)
    for one, other in zip(rig.rays(), again.rays(), strict=True):
        assert torch.allclose(one, other, atol=1e-9)


def test_rows_map_to_slices_and_the_axis_to_its_column():
    detector = {"pixels": [6, 9], "pixel_mm": [1.0, 1.5], "offset_mm": [0.0, 3.0]}
    box, rig = framed(
        Grid.centred(size=(7, 7, 4), spacing=(1.5, 1.5, 1.0)),
        parallel(3, detector, 60.0, start_degrees=20.0),
    )
    assert plane_of_rows(box, rig, "it") == [(1, 3), (2, 2), (3, 1), (4, 0)]
    angles, columns = turns(box, rig)
    assert columns == [2, 2, 2]
    assert angles[1] - angles[0] == pytest.approx(-60.0)


TILTED = CONE.moved(random_rotation(torch.Generator().manual_seed(0)), torch.zeros(3))
FLAT = Grid.centred(size=(7, 7, 5), spacing=2.0)
STACK = parallel(3, {"pixels": [5, 7], "pixel_mm": 2.0}, 60.0)
SHEARED = Grid(GRID.shape, GRID.affine + torch.tensor([[0.0, 0.3, 0.0, 0.0]] + [[0.0] * 4] * 3))
REFUSED = {
    "sheared grid": (Nanodrr, SHEARED, CONE, {}, "right angles"),
    "central line": (
        Nanodrr,
        GRID,
        replace(CONE, extent="line"),
        {},
        "got central cameras of extent 'line'",
    ),
    "one sample": (Nanodrr, GRID, CONE, {"samples": 1}, "at least 2 samples on a ray, got 1"),
    "unknown method": (
        Diffdrr,
        GRID,
        CONE,
        {"method": "joseph"},
        "one of siddon, trilinear, got 'joseph'",
    ),
    "source inside": (
        Diffdrr,
        GRID,
        replace(CONE, source=GRID.centre + CONE.source * 0),
        {},
        "140 of 140 rays",
    ),
    "next to the source": (
        Rtk,
        GRID,
        replace(CONE, source=CONE.origin - 1e-6 * NORMAL),
        {},
        "no nearer to the source",
    ),
    "needles": (
        Rtk,
        Grid.centred(size=(7, 7, 5), spacing=(1.0, 1e-4, 1.0)),
        CONE,
        {},
        "at most 1000 times as long as wide",
    ),
    "skew pixels": (Rtk, GRID, replace(CONE, v=CONE.v + 0.1 * CONE.u), {}, "right angles"),
    "two pixel sizes": (
        Rtk,
        GRID,
        replace(CONE, u=CONE.u * torch.arange(1, 5)[:, None]),
        {},
        "one pixel size",
    ),
    "slanted beam": (
        Rtk,
        GRID,
        replace(BEAM, origin=BEAM.origin + 9 * BEAM.u),
        {},
        "square to their detector",
    ),
    "pose gradient": (
        Rtk,
        GRID,
        replace(CONE, u=CONE.u.clone().requires_grad_()),
        {},
        "no gradient in the cameras",
    ),
    "cone in 2-D": (Astra, GRID, CONE, {}, "stay in the middle of a slice"),
    "oblong voxels": (
        Astra,
        Grid.centred(size=(7, 7, 5), spacing=(2.0, 1.5, 2.0)),
        STACK,
        {},
        "square voxels, got 2 by 1.5 mm",
    ),
    "linear fan": (
        Astra,
        FLAT,
        circular(3, 40, 70, {"pixels": [1, 9], "pixel_mm": 2.0}),
        {"method": "linear"},
        "fan",
    ),
    "rows between": (
        Astra,
        FLAT,
        STACK.moved(torch.eye(3), torch.tensor([0, 0, 1.0])),
        {},
        "got rays 0.5 slices off",
    ),
    "pinholes": (Mbirtorch, GRID, PINHOLES, {}, "a circle or a helix about the z axis"),
    "tilted circle": (Mbirtorch, GRID, TILTED, {}, "a circle or a helix about the z axis"),
    "axis elsewhere": (
        Mbirtorch,
        GRID,
        CONE.moved(torch.eye(3), torch.tensor([1.0, 0, 0])),
        {},
        "volume's centre",
    ),
    "cone to radon": (Skimage, FLAT, CONE, {}, "takes parallel beams, got central"),
    "wide columns": (
        Skimage,
        Grid.centred(size=(7, 7, 5), spacing=1.9),
        STACK,
        {},
        "as wide as the detector's columns",
    ),
    "even size": (Skimage, Grid.centred(size=(8, 8, 5), spacing=2.0), STACK, {}, "take odd sizes"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_unsupported_geometry_is_refused_with_the_reason(why: str):
    part, grid, rig, options, message = REFUSED[why]
    with pytest.raises(ValueError, match=message):
        part(grid, rig, **options)
