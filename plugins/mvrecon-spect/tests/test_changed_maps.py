"""Attenuation, and whatever is derived from it, follows every change of a map.

Tried: memory of NumPy, `.numpy()` of a tensor, in-place operations, `.data`, an inference tensor,
assignment, the maps of cases, and compiled calls; for whole rigs, subsets and blur, views,
adjoints, networks in evaluation and training; and cameras that change after construction.
"""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.data.module import SceneData
from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Box, Grid
from mvrecon.methods.calibration import self_alignment
from mvrecon.methods.method import build_method
from mvrecon.operators.memo import determinants
from mvrecon.operators.selection import view_subset
from mvrecon_spect.operators.projector import Spect

GRID = Grid.centred(12, spacing=12.0)
RIG = dcspect80(pixels=8, columns=[0, 7, 13], rows=[0, 2])
SMALL = {"widths": [2, 4], "depth_widths": [2], "weight_widths": [2], "features": 1, "scale": 1}
NETWORK = {"name": "cross_view", "depths": 4, "start": 6, **SMALL}
KINDS = {
    "plain": lambda mu, rig=RIG: Spect(GRID, rig, mu=mu),
    "subset": lambda mu, rig=RIG: view_subset(Spect(GRID, rig, mu=mu), [4, 1]),
    "blurred": lambda mu, rig=RIG: Spect(GRID, rig, mu=mu, blur=True, intrinsic_mm=30.0),
}
FILLS = {
    "in place": lambda mu, other: mu.copy_(other),
    "data": lambda mu, other: setattr(mu, "data", other.clone()),
    "data in place": lambda mu, other: mu.data.copy_(other),
    "NumPy": lambda mu, other: np.copyto(mu.numpy(), other.numpy()),
}


def body(strength=1.0):
    mu = torch.zeros(GRID.shape)
    mu[3:9, 2:9, 4:10] = 0.02 * strength
    mu[:, :, 7:] *= 0.3
    return mu


def zeros(memory):
    if memory == "NumPy":
        return torch.from_numpy(np.zeros(GRID.shape, np.float32))
    with torch.inference_mode(memory == "inference"):
        return torch.zeros(GRID.shape)


def agree(A, B):
    x, y = torch.rand(1, 1, *GRID.shape), torch.rand(1, 1, *A.range_shape)
    for _ in range(3):  # from the second call on, transmission is cached
        torch.testing.assert_close(A(x), B(x), rtol=1e-6, atol=0)
        torch.testing.assert_close(A.T(y), B.T(y), rtol=1e-6, atol=0)


@pytest.mark.pairwise(fill=FILLS, kind=KINDS, memory=["torch", "NumPy", "inference"])
def test_a_map_of_zeros_that_is_filled_later_attenuates(kind, fill, memory):
    build, mu = KINDS[kind], zeros(memory)
    A = build(mu)
    agree(A, build(torch.zeros(GRID.shape)))
    for other in (body(), body(0.5), torch.zeros(GRID.shape)):
        with torch.inference_mode(memory == "inference"):
            FILLS[fill](mu, other)
        agree(A, build(other))
        assert (A.mu_map() is None) == (not other.any())


ASSIGNED = {**FILLS, "assigned": None}


@pytest.mark.pairwise(change=ASSIGNED, kind=["plain", "blurred"])
@torch.no_grad()
def test_a_network_uses_the_weights_of_the_present_map(kind, change):
    """SIRT's weights and the frames' transmission, in evaluation and in training."""
    build, method = KINDS[kind], build_method(NETWORK)
    A, mu = build(body()), body().flip(2)
    y = A(torch.rand(1, 1, *GRID.shape))
    method(y, A)
    part = A.A
    if change == "assigned":
        part.mu = mu
    else:
        FILLS[change](part.mu, mu)
    for mode in (True, False):
        torch.testing.assert_close(
            method.train(mode)(y, A).volume, method(y, build(mu)).volume, rtol=1e-5, atol=1e-8
        )


@torch.no_grad()
def test_cases_with_maps_of_their_own_are_aligned_in_any_batch(monkeypatch):
    """Cached and new ones, with equal views too, by operators that are built for each batch."""
    monkeypatch.setattr(self_alignment, "ITERATIONS_FROM_ZERO", 3)  # else nearly all of the time
    aligned = {"name": "aligned", "method": {"name": "sirt", "iterations": 3}}
    aligned |= {"alternations": 1, "iterations": 2}
    A, maps = Spect(GRID, RIG, mu="case"), torch.stack([body(), body(0.5), body().flip(2)])[:, None]
    y = A.for_case({"mu": maps})(torch.rand(3, 1, *GRID.shape))
    y[:, :, ::2] = y[:, :, ::2].roll(1, -1)  # found, and not left as it is, which every map has
    y[2] = y[1]
    each = [A.for_case({"mu": maps[[i]]}) for i in range(3)]
    alone = [build_method(aligned)(y[[i]], B).volume for i, B in enumerate(each)]
    apart = [build_method(aligned)(y[[i]], each[i]).alignment for i in (1, 2)]
    assert (apart[0].shift_px - apart[1].shift_px).norm() > 0.01
    method = build_method(aligned).train()
    for batch in ([0, 1], [1, 2], [2, 0]):
        volume = method(y[batch], A.for_case({"mu": maps[batch]})).volume
        torch.testing.assert_close(volume, torch.cat(alone)[batch], rtol=1e-5, atol=1e-8)


def test_the_operator_of_a_case_knows_its_map_before_its_first_call():
    """Which may be in a graph of `torch.compile`."""
    A, x = Spect(GRID, RIG, mu="case"), torch.rand(1, 1, *GRID.shape)
    B = A.for_case({"mu": body()[None, None]}).of_sample(0)
    torch.compiler.reset()
    y = torch.compile(B, backend="eager")(x)
    torch.testing.assert_close(y, Spect(GRID, RIG, mu=body())(x))


@pytest.mark.parametrize("change", ["in place", "NumPy", "assigned"])
def test_a_map_of_zeros_that_is_filled_later_attenuates_in_compiled_graphs(change):
    """Tried too: `.data`, and a map that was not zero at first."""
    mu, x = torch.zeros(GRID.shape), torch.rand(1, 1, *GRID.shape)
    A = Spect(GRID, RIG, mu=mu)
    torch.compiler.reset()
    compiled = torch.compile(A, backend="eager")
    compiled(x)
    for other in (body(), torch.zeros(GRID.shape), body(0.5)):
        if change == "assigned":
            A.A.mu = other
        else:
            FILLS[change](mu, other)
        torch.testing.assert_close(compiled(x), Spect(GRID, RIG, mu=other)(x))


def test_pinholes_of_a_changed_rig_are_refused():
    rig = RIG[:]
    A, x = Spect(GRID, rig, blur=True, intrinsic_mm=30.0), torch.rand(1, 1, *GRID.shape)
    y = deepcopy(A)(x)
    assert torch.equal(A(x), y)
    rig.source.add_(1.0)
    for call in (lambda: A(x), lambda: A.T(y), lambda: deepcopy(A)):
        with pytest.raises(RuntimeError, match="changed in place after"):
            call()


def test_pinholes_follow_a_rig_that_is_optimised():
    rig = RIG[[0]]
    rig.source.requires_grad_()
    A, x = Spect(GRID, rig, blur=True, intrinsic_mm=30.0), torch.rand(1, 1, *GRID.shape).double()
    for _ in range(2):
        A(x).square().sum().backward()
        with torch.no_grad():
            rig.source.add_(1.0)
    fixed = Spect(GRID, RIG[[0]].__class__(
        rig.source.detach(), rig.origin, rig.u, rig.v, rig.shape, extent="behind"
    ), blur=True, intrinsic_mm=30.0)  # fmt: skip
    torch.testing.assert_close(A(x).detach(), fixed(x), rtol=1e-6, atol=0)


@torch.no_grad()
def test_attenuation_is_along_the_present_poses():
    """Cameras that are optimised, between evaluations without gradients."""
    rig = deepcopy(RIG[[0]])
    rig.source.requires_grad_()
    A, x = Spect(GRID, rig, mu=body()), torch.rand(1, 1, *GRID.shape)
    before = A(x)
    rig.source.add_(20.0)
    fixed = replace(rig, source=rig.source.detach().clone())
    expected = Spect(GRID, fixed, mu=body())(x)
    torch.testing.assert_close(A(x), expected, rtol=1e-5, atol=0)
    assert (before - expected).norm() > 0.01 * expected.norm()


MOVES = {"fixed": (False, False), "before": (True, True), "afterwards": (False, True)}


@pytest.mark.parametrize("gradient", MOVES)
@pytest.mark.parametrize("kind", ["plain", "blurred"])
@torch.no_grad()
def test_cameras_that_move_are_followed_or_refused(kind, gradient):
    """Whether they require a gradient: never, before the operator is built, or afterwards."""
    before, afterwards = MOVES[gradient]
    rig = deepcopy(RIG)
    rig.source.requires_grad_(before)
    A, x = KINDS[kind](body(), rig), torch.rand(1, 1, *GRID.shape)
    old = A(x)
    rig.source.requires_grad_(afterwards)
    rig.source.add_(20.0)
    fixed = replace(rig, source=rig.source.detach().clone())
    if gradient == "fixed":
        for call in (lambda: A(x), lambda: A.T(old)):
            with pytest.raises(RuntimeError, match="changed in place after"):
                call()
        return
    B = KINDS[kind](body(), fixed)
    for one, other in ((A(x), B(x)), (A.T(old), B.T(old))):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6 * other.abs().max().item())


@pytest.mark.pairwise(part=["subset", "crop"], graph=[False, True], mu=[False, True])
def test_parts_follow_cameras_that_are_optimised(part, graph, mu):
    """Also tried: plain and blurred, supports, products; central differences."""
    rig, x = deepcopy(RIG), torch.rand(1, 1, *GRID.shape).double()
    rig.source.requires_grad_()
    A = Spect(GRID, rig, mu=body() if mu else None)
    with torch.set_grad_enabled(graph):
        B = view_subset(A, [4, 1]) if part == "subset" else A.cropped(Box.whole(GRID.shape), [4, 1])
    assert B.pose_gradient
    for _ in range(2):
        views = B(x), A(x)[:, :, [4, 1]]
        torch.testing.assert_close(*views, rtol=1e-6, atol=0)
        slopes = [torch.autograd.grad(y.square().sum(), rig.source)[0] for y in views]
        assert slopes[1].any()
        torch.testing.assert_close(*slopes, rtol=1e-5, atol=1e-9)
        with torch.no_grad():
            rig.source.add_(1.0)


@torch.no_grad()
def test_cached_transmission_does_not_count_as_the_state_of_an_operator():
    """Else every look-up of a derived value would compare it, and keep a copy."""
    A = Spect(GRID, RIG, mu=body())
    before = len(determinants(A))
    A(torch.rand(1, 1, *GRID.shape))
    assert len(determinants(A)) == before


def test_a_stored_case_follows_the_file_of_its_attenuation(tmp_path, parts):
    """Cases of `data.cache` are those of the map in the file, not of its name; a file that is
    written again with the same values makes no new case.
    """
    path, folder = tmp_path / "mu.nii.gz", tmp_path / "cases"
    scenes = dict.fromkeys(("train", "test"), {"name": "ellipsoids", "value": 1.0})
    camera = {"name": "dcspect80", "pixels": 8, "columns": [0, 13], "rows": [0]}
    measurement = {"grid": {"size": 12, "spacing": 12.0}, "camera": camera}
    measurement["projector"] = {"name": "spect", "mu": str(path)}
    sizes = {"train": 1, "val": 1, "test": 1}

    def views(**options):
        data = SceneData(scenes, measurement, sizes, **options)
        data.setup("fit")
        return data.sets["train"].prepare()["views"]

    for strength, files in ((1.0, 2), (1.0, 2), (0.5, 4)):
        save_volume(path, body(strength), GRID)
        assert torch.equal(views(cache=str(folder)), views())
        assert len([*folder.iterdir()]) == files
