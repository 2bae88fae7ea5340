"""Leaving out what is zero changes no bit; a support is part of the operator; what pays is chosen
by counting.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.cameras.dcspect80 import dcspect80
from mvrecon.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.box import Box
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.cpu import nonzero, plan, skip_policy
from mvrecon.kernels.rays.cpu.nonzero import bricks_of
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy
from mvrecon.projectors import integrals
from tests.projectors.cases import Case, curved

pytestmark = pytest.mark.usefixtures("nothing_is_too_little")

#: No size is a multiple of a brick's edge, and no two spacings are alike.
GRID = Grid.centred(size=(33, 26, 19), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
DETECTOR = {"pixels": [17, 14], "pixel_mm": [3.1, 4.3], "offset_mm": [0.37, -0.6]}
TURNED = random_rotation(torch.Generator().manual_seed(3))


def about(rig):
    """A rig about the grid's centre."""
    return rig.moved(torch.eye(3), GRID.centre)


ALONG = parallel(4, {"pixels": [19, 40], "pixel_mm": [1.0, 0.9]}, 60.0, start_degrees=0.0)
CASES = {
    "cone": Case(GRID, about(circular(5, 60.0, 100.0, DETECTOR, start_degrees=13.0))),
    "stack": Case(GRID, about(parallel(4, DETECTOR, 90.0, start_degrees=11.0))),
    "dome": Case(GRID, about(dome(5, 45.0, 30.0, 120.0, DETECTOR))),
    "beams": Case(GRID, parallel(3, DETECTOR, 90.0, start_degrees=11.0).moved(TURNED, GRID.centre)),
    "along rows": Case(GRID, about(ALONG)),
    "inside": Case(
        GRID,
        about(circular(3, 9.0, 40.0, DETECTOR, start_degrees=13.0).moved(TURNED, torch.ones(3))),
    ),
    "dcspect80": Case(
        Grid.centred(size=(33, 26, 19), spacing=(9.0, 8.0, 7.0)), dcspect80()[::13].binned(6)
    ),
    "explicit": Case(GRID, curved(9, 7)),
}
METHODS = ["joseph", "siddon", "trilinear", "trilinear:7"]
WAYS = ["box", "brick", "auto", "verify"]


def volumes(kind: str, dtype: torch.dtype = torch.float32, count: int = 1) -> torch.Tensor:
    """Volumes [1 c d h w] of which little is there."""
    rng = torch.Generator().manual_seed(5)
    values = torch.rand(1, count, *GRID.shape, generator=rng, dtype=torch.float64) + 0.5
    mask = torch.zeros(GRID.shape, dtype=torch.bool)
    if kind == "blob":
        mask[5:9, 11:20, 8:14] = True
    elif kind == "corners":  # a voxel in each corner and on an edge of a brick
        for z, y, x in [
            (8, 8, 8),
            (15, 15, 15),
            (8, 15, 23),
            (12, 16, 24),
            (7, 7, 31),
            (16, 8, 12),
        ]:
            mask[z, y, x] = True
    elif kind == "checkerboard":
        z, y, x = torch.meshgrid(*[torch.arange(n) // EDGE for n in GRID.shape], indexing="ij")
        mask = (z + y + x) % 2 == 0
    elif kind == "end":
        mask[18, 25, 32] = mask[0, 25, 0] = True
    elif kind == "full":
        mask[:] = True
    return torch.where(mask, values, 0).to(dtype)


KINDS = ["blob", "corners", "checkerboard", "end", "full", "empty"]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", CASES)
def test_skipping_zeros_changes_no_bit(kind, method):
    case = CASES[kind]
    operators = {skip: case.build(method=method, skip=skip) for skip in ["off", *WAYS]}
    for shape in KINDS:
        for dtype, count in ((torch.float32, 1), (torch.float64, 1), (torch.float32, 5)):
            x = volumes(shape, dtype, count)
            dense = operators["off"](x)
            assert operators["off"].skipped.mode == "off"
            for skip in WAYS:
                assert torch.equal(operators[skip](x), dense), (shape, dtype, count, skip)
            assert (
                bool(dense.any())
                or shape not in ("blob", "checkerboard", "full")
                or method == "trilinear:7"
            )


@pytest.mark.parametrize("kind", ["cone", "dome"])
def test_random_rays_agree_to_the_last_bit(kind):
    """Ten thousand and more rays in random poses of the grid."""
    rng = torch.Generator().manual_seed(11)
    for _ in range(6):
        rig = CASES[kind].rays.moved(
            random_rotation(rng) if kind == "dome" else torch.eye(3), torch.rand(3) - 0.5
        )
        case = Case(GRID, rig.refined(2))
        for shape in ("blob", "checkerboard"):
            x = volumes(shape)
            for method in ("joseph", "siddon"):
                dense = case.build(method=method, skip="off")(x)
                assert torch.equal(case.build(method=method, skip="brick")(x), dense)


@pytest.mark.parametrize("budget", [1, 4 * 8 * 3000])
@pytest.mark.parametrize("kind", ["cone", "dome"])
def test_pieces_and_threads_change_no_bit_either(kind, budget, monkeypatch):
    monkeypatch.setattr(plan, "BUDGET", budget)
    monkeypatch.setattr("mvrecon.kernels.threads.LEAST", 1)
    case, before = CASES[kind], torch.get_num_threads()
    try:
        for shape in ("blob", "checkerboard"):
            x, found = volumes(shape), []
            for threads in (1, 3):
                torch.set_num_threads(threads)
                found += [case.build(skip=skip)(x) for skip in ("off", "box", "brick")]
            assert all(torch.equal(found[0], other) for other in found[1:])
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf, 1e-42, -0.0])
@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear"])
@pytest.mark.parametrize("kind", ["cone", "dome"])
def test_what_is_not_a_number_is_not_skipped(kind, method, bad):
    for place in ((8, 8, 8), (7, 16, 23), (18, 25, 32)):
        x = volumes("blob")
        x[0, 0][place] = bad
        dense = CASES[kind].build(method=method, skip="off")(x)
        for skip in ("box", "brick"):
            views = CASES[kind].build(method=method, skip=skip)(x)
            assert torch.equal(views.isnan(), dense.isnan())
            assert torch.equal(views.nan_to_num(), dense.nan_to_num())


def test_halves_are_looked_at_as_they_are():
    for dtype in (torch.float16, torch.bfloat16):
        x = volumes("blob", dtype)
        dense = CASES["cone"].build(skip="off")(x)
        for skip in ("box", "brick", "verify"):
            A = CASES["cone"].build(skip=skip)
            assert torch.equal(A(x), dense) and A.skipped.fractions["voxels"] < 0.1


def test_nothing_stale_is_ever_used():
    """The volume is looked at in every call, so no edit can go unseen, however it is made."""
    A, dense = (CASES["cone"].build(skip=skip) for skip in ("brick", "off"))
    x = volumes("blob")
    A(x)
    x[0, 0, 2, 3, 4] = 7  # in place
    assert torch.equal(A(x), dense(x))
    x.data[0, 0, 17, 20, 30] = 5  # past torch's count of versions
    assert torch.equal(A(x), dense(x))
    x.numpy()[0, 0, 1, 24, 2] = 3  # by another library
    assert torch.equal(A(x), dense(x))
    x.zero_()
    x[0, 0, 18, 0, 0] = 1  # another volume at the same address
    assert torch.equal(A(x), dense(x))


def test_verify_finds_a_kernel_that_skips_too_much(monkeypatch):
    A = CASES["cone"].build(skip="verify")
    x = volumes("blob")
    A(x)
    wrong = Occupancy(Box.whole(GRID.shape).high, Box((6, 12, 9), (7, 14, 12))).encoded()
    monkeypatch.setattr(integrals.ops, "occupied", lambda *arguments: wrong)
    with pytest.raises(RuntimeError, match="skip='verify': [0-9]+ of 1190 pixels differ"):
        A(x)


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear"])
def test_the_gradient_by_the_volume_is_the_dense_one(method):
    y = None
    found = []
    for skip in ("off", "box", "brick"):
        A = CASES["dome"].build(method=method, skip=skip)
        x = volumes("blob").requires_grad_()
        views = A(x)
        y = torch.randn(views.shape, generator=torch.Generator().manual_seed(1)) if y is None else y
        found.append(torch.autograd.grad(views, x, y)[0])
    assert found[0][0, 0, 0, 0].abs().sum() > 0, "it is not zero where the volume is"
    assert all(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.parametrize("method", ["joseph", "siddon", "trilinear"])
@pytest.mark.parametrize("kind", ["cone", "dome", "explicit"])
def test_the_gradient_by_the_geometry_is_the_dense_one(kind, method):
    case, found = CASES[kind], []
    for skip in ("off", "box", "brick"):
        leaves = [vector.clone().requires_grad_() for vector in case.vectors.values()]
        views = case.moved(*leaves).build(method=method, skip=skip)(volumes("blob", torch.float64))
        found.append(torch.autograd.grad(views.square().sum(), leaves))
    for other in found[1:]:
        for one, two in zip(found[0], other, strict=True):
            assert torch.allclose(one, two, rtol=0, atol=1e-12 * one.abs().max().item())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"skip": "boxes"}, "Unknown skip 'boxes'. Known: auto, off, box, brick, verify"),
        (
            {"support": torch.ones(3, 3, 3, dtype=torch.bool)},
            r"shape \(19, 26, 33\), got bool of \(3, 3, 3\)",
        ),
        ({"support": torch.ones(19, 26, 33)}, r"mask of bool .* got float32 of \(19, 26, 33\)"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        CASES["cone"].build(**options)


def test_views_that_are_zero_are_not_spread():
    """Zeros add nothing to the adjoint, so leaving their rays out changes no bit of it."""
    for kind in ("cone", "dome"):
        A = CASES[kind].build()
        y = torch.rand(1, 1, 5, 17, 14)
        y[0, 0, :, 5:, :9] = 0
        y[0, 0, 2] = 0
        whole = sum(A.T(torch.where(torch.arange(5)[:, None, None] == m, y, 0)) for m in range(5))
        assert torch.allclose(A.T(y), whole, rtol=1e-5, atol=1e-5)
        oracle = CASES[kind].build(backend="reference")
        assert torch.allclose(A.T(y.double()), oracle.T(y.double()), atol=1e-11)


def test_bricks_hold_what_is_there_and_what_is_just_behind():
    x = volumes("corners").flatten(0, 1)
    box = Box.around(x[0] != 0)
    found = bricks_of(x.numpy(), box)
    for k, j, i in torch.cartesian_prod(*[torch.arange(n) for n in found.shape]).tolist():
        part = x[
            0,
            k * EDGE : k * EDGE + EDGE + 1,
            j * EDGE : j * EDGE + EDGE + 1,
            i * EDGE : i * EDGE + EDGE + 1,
        ]
        assert bool(found[k, j, i]) == bool(part.any())


def test_the_choice_is_told_and_follows_the_scene():
    """A full volume: nothing to skip. A small object: its box. Two small ones in far corners:
    bricks.
    """
    grid = Grid.centred((64, 64, 64), 1.0)
    A = Case(grid, dome(4, 120.0, 60.0, 120.0, {"pixels": [96, 96], "pixel_mm": 0.45})).build()
    x = torch.rand(1, 1, 64, 64, 64) + 0.1
    A(x)
    assert (A.skipped.mode, A.skipped.box) == (
        "off",
        Box.whole((64, 64, 64)),
    ) and "full" in A.skipped.why
    A(torch.nn.functional.pad(x[..., 20:40, 20:40, 20:40], (20, 24) * 3))
    assert (A.skipped.mode, A.skipped.box) == ("box", Box((20,) * 3, (40,) * 3))
    far = torch.zeros_like(x)
    far[..., :6, :6, :6] = far[..., -6:, -6:, -6:] = 1
    A(far)
    assert (
        A.skipped.mode == "brick"
        and A.skipped.fractions["brick"] < 0.5 * A.skipped.fractions["box"]
    )
    assert "bricks" in A.skipped.why


def test_bricks_are_left_where_the_box_leaves_little_work(monkeypatch):
    """What a call costs besides its slabs would hide what they save."""
    grid = Grid.centred((64, 64, 64), 1.0)
    A = Case(grid, dome(4, 120.0, 60.0, 120.0, {"pixels": [96, 96], "pixel_mm": 0.45})).build()
    x = torch.zeros(1, 1, 64, 64, 64)
    x[..., 8:12, 8:12, 8:12] = x[..., 36:40, 36:40, 36:40] = 1
    views = A(x)
    assert A.skipped.mode == "brick"
    scene = plan.Scene(A.lines, A.ray_extent, A.detector, A.kernel)
    monkeypatch.setattr(skip_policy, "MUCH", scene.slabs(grid.shape))
    assert torch.equal(A(x), views)
    assert A.skipped.mode == "box" and "too little to gain" in A.skipped.why


def test_small_work_is_not_looked_at(monkeypatch):
    monkeypatch.undo()
    A = CASES["cone"].build()
    A(volumes("blob"))
    assert A.skipped.mode == "off" and "small work" in A.skipped.why


class Counted(np.ndarray):
    """Voxels that count how often one is read."""

    reads = 0

    def __getitem__(self, place):
        Counted.reads += 1
        return super().__getitem__(place)


def test_of_a_full_volume_few_voxels_are_looked_at(monkeypatch):
    """A row of each face of its box, and one voxel of each of a few hundred bricks."""
    for name in ("inward", "look", "_face_holds", "_brick_holds", "_stride"):
        monkeypatch.setattr(nonzero, name, getattr(nonzero, name).py_func)
    monkeypatch.setattr(
        skip_policy, "bricks_of", lambda *_: pytest.fail("all voxels are looked at")
    )
    Counted.reads = 0
    monkeypatch.setattr(
        skip_policy, "readable", lambda volumes: nonzero.readable(volumes).view(Counted)
    )
    case = CASES["cone"]
    A = replace(case, grid=Grid.centred((64, 64, 64), 1.0)).build(skip="auto")
    full = torch.rand(1, 64, 64, 64) + 0.1
    held = skip_policy.occupancy_of(
        full, plan.Scene(A.lines, A.ray_extent, A.detector, A.kernel), "auto"
    )
    assert held.box == Box.whole((64, 64, 64)) and held.bricks is None
    assert 0 < Counted.reads < full.numel() / 200


def test_compiled_and_mapped_calls_skip_too():
    A = CASES["cone"].build(skip="box")
    x = volumes("blob")
    compiled = torch.compile(A, backend="eager", fullgraph=True)
    assert torch.equal(compiled(x), A(x))


def test_the_reference_needs_no_skipping():
    A = CASES["cone"].build(backend="reference", skip="brick")
    x = volumes("blob", torch.float64)
    expected = reference.project(x[0], A.lines, A.ray_extent, A.detector, A.kernel)
    assert torch.equal(A(x)[0], expected) and A.skipped.mode == "off"
    assert replace(A.skipped, why="") == replace(A.with_support(None).skipped, why="")
