"""Classical starts: by number and by name, on a finer grid, and kept during a training."""

from copy import deepcopy
from dataclasses import replace
from pickle import dumps, loads

import pytest
import torch

from mvrecon.core.parts import METHODS
from mvrecon.geometry.grid import Grid
from mvrecon.methods.calibration import self_alignment
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.learned import start as starts
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.learned.start import ClassicalStart
from mvrecon.methods.method import build_method
from mvrecon.operators.operator import PerSample, Scaled
from mvrecon.operators.ray_transform import RayTransform
from tests.methods.learned.rig import blob, small, small_projector, small_rig

SIRT = {"name": "sirt", "iterations": 3}


@pytest.fixture
def made(monkeypatch):
    """The views of every volume that a classical method has reconstructed."""
    views, build = [], METHODS.from_config

    def counted(config, A, own, **options):
        views.extend(own)
        return build(config, A, own, **options)

    monkeypatch.setattr(METHODS, "from_config", counted)
    return views


def test_in_training_a_case_is_reconstructed_once_in_any_batch(made):
    projector = small_projector()
    geometry, views = Geometry.of(projector), projector(blob(projector, 3))
    views = views * torch.tensor([1.0, 2.0, 3.0])[:, None, None, None, None]
    start = ClassicalStart(SIRT)
    first = start(geometry, views, training=True)
    assert len(made) == 3
    assert torch.equal(start(geometry, views[[2, 0]], training=True), first[[2, 0]])
    assert len(made) == 3
    assert torch.equal(start(geometry, views), first) and len(made) == 6
    assert torch.allclose(first, sirt(projector, views, 3), rtol=1e-4, atol=1e-6)


def test_a_volume_that_does_not_fit_into_the_cache_is_recomputed(made, monkeypatch):
    projector = small_projector()
    geometry, views = Geometry.of(projector), projector(blob(projector, 2))
    views[1] *= 2
    monkeypatch.setattr(starts, "CACHE_BYTES", 4 * 12**3)
    start = ClassicalStart(SIRT)
    for _ in range(2):
        start(geometry, views, training=True)
    assert len(made) == 3


def test_training_from_a_finer_grid_uses_the_initial_volume_of_evaluation(made):
    projector = small_projector()
    model = small("cross_view", start={"name": "finer", "method": SIRT})
    views = projector(blob(projector))
    trained = model.train()(views, projector)
    trained.volume.sum().backward()
    again, evaluated = model(views, projector), model.eval()(views, projector)
    assert torch.equal(again.volume, trained.volume)
    assert torch.equal(evaluated.start, trained.start)
    plain = small("cross_view", start=3)(views, projector).start
    assert not torch.allclose(trained.start, plain, rtol=1e-2)
    assert len(made) == 4  # "finer" and its method, once in training and once in evaluation


def operators():
    """Operators of the same sizes that differ in one way each."""
    grid, rig = small_rig()
    half = torch.zeros(grid.shape, dtype=torch.bool)
    half[3:] = True
    drr = RayTransform(grid, rig)
    ramp = torch.linspace(0.5, 2, 12)
    return {
        "rig": RayTransform(grid, rig.moved(torch.eye(3).double(), torch.ones(3).double())),
        "spacing": RayTransform(Grid.centred(12, 1.5), rig),
        "place": RayTransform(Grid.centred(12, 2.0, centre=(2.0, 0, 0)), rig),
        "pixel": RayTransform(grid, replace(rig, u=0.9 * rig.u)),
        "method": RayTransform(grid, rig, "siddon"),
        "rays": RayTransform(grid, rig, rays_per_pixel=3),
        "support": RayTransform(grid, rig, support=half),
        "weights": Scaled(drr, ramp),
        "function": Scaled(drr, lambda: ramp.flip(0)),
        "voxels": Scaled(drr, voxels=1 + half.float()),
        "factor": 2.0 * drr,
    }


METHODS_OF_CASES = {
    "start": lambda: small("cross_view", start=SIRT).train(),
    "aligned": lambda: build_method(
        {"name": "aligned", "method": SIRT, "alternations": 1, "iterations": 2}
    ).train(),
}


@pytest.fixture
def few_iterations(monkeypatch):
    """Of an alignment, which take nearly all of the time; the case does not depend on them."""
    monkeypatch.setattr(self_alignment, "ITERATIONS_FROM_ZERO", 3)


@pytest.mark.parametrize("name", METHODS_OF_CASES)
@torch.no_grad()
def test_the_result_of_a_case_is_that_of_its_operator(name, few_iterations):
    """Equal views with another rig, grid, pixel, method, number of rays, support, weight, or with
    one of them modified in place, by assignment or by other options; in one batch and in turn.
    """
    build, first, others = METHODS_OF_CASES[name], small_projector(), operators()
    y, method = first(blob(first)), build()
    volumes = [method(y, A).volume for A in (first, *others.values())]
    for A, volume in zip((first, *others.values()), volumes, strict=True):
        assert torch.equal(volume, build()(y, A).volume)
        assert torch.equal(volume, method(y, deepcopy(A)).volume)
    A = others["weights"]
    for change in (
        lambda: A.fixed_factors.mul_(A.fixed_factors),
        lambda: setattr(A, "fixed_factors", A.fixed_factors.flip(0)),
        lambda: A.fixed_factors.numpy().fill(3.0),
        lambda: setattr(A, "A", others["method"]),
    ):
        change()
        assert torch.equal(method(y, A).volume, build()(y, A).volume)


@pytest.mark.parametrize("name", METHODS_OF_CASES)
@torch.no_grad()
def test_a_batch_of_cached_and_new_cases_with_operators_of_their_own(name, few_iterations):
    grid, rig = small_rig()
    ramp = torch.linspace(0.5, 1.5, 12)
    each = [Scaled(RayTransform(grid, rig), ramp**power) for power in (0, 1, 2)]
    y = torch.cat([A(blob(A)) for A in each])
    y[2] = y[1]  # equal views of different operators
    build = METHODS_OF_CASES[name]
    alone = torch.cat([build()(y[[i]], PerSample([each[i]])).volume for i in range(3)])
    for batches in (([0, 1], [1, 2]), ([0], [2, 0, 1]), ([0, 0], [1, 0])):
        method = build()
        for batch in batches:
            out = method(y[batch], PerSample([each[i] for i in batch])).volume
            torch.testing.assert_close(out, alone[batch], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("outer", [{}, {"name": "finer"}])
@torch.no_grad()
def test_a_method_that_is_defined_again_computes_its_cases_anew(monkeypatch, outer):
    """As by running a notebook's cell again, alone and within another method."""
    monkeypatch.setattr(METHODS, "_parts", dict(METHODS._parts))
    A = small_projector()
    geometry, y = Geometry.of(A), A(blob(A))
    METHODS._parts["cell"] = lambda A, views: A.T(views)
    start = ClassicalStart({**outer, "method": {"name": "cell"}} if outer else {"name": "cell"})
    first = start(geometry, y, training=True)
    METHODS._parts["cell"] = lambda A, views: 2 * A.T(views)
    torch.testing.assert_close(start(geometry, y, training=True), 2 * first)


@torch.no_grad()
def test_other_options_dtypes_and_supports_are_other_cases(made):
    A = small_projector()
    geometry, y = Geometry.of(A), A(blob(A))
    start = ClassicalStart(dict(SIRT))
    first = start(geometry, y, training=True)
    assert start(geometry, y.double(), training=True).dtype == torch.float64 and len(made) == 2
    half = torch.zeros(1, 1, *A.grid.shape, dtype=torch.bool)
    half[..., :6] = True
    within = start(Geometry.of(A, support=half), y, training=True)
    assert len(made) == 3 and not within[~half].any() and first[~half].any()
    start.start["iterations"] = 20
    assert not torch.allclose(start(geometry, y, training=True), first, rtol=1e-2)
    assert len(made) == 4
    for copied in (deepcopy(start), loads(dumps(start))):
        assert torch.equal(copied(geometry, y, training=True), start(geometry, y, training=True))
