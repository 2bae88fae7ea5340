"""Values cached beside an operator, a rig or a tensor follow everything that determines them.

Ways of changing a tensor that were tried: assignment, in-place operations, `.data =`,
`.data.copy_`, `.numpy()`, memory given by NumPy, and inference tensors. Ways of changing an
operator: tensors of its own, of an operator that is not a module within it, of a record or plain
object, of a closure; NumPy arrays; options; another operator in its place.
"""

import gc
import weakref
from copy import deepcopy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from mvrecon.geometry.grid import Grid
from mvrecon.operators import memo
from mvrecon.operators.memo import contents, grid_key, kept, place
from mvrecon.operators.operator import LinearOperator, PerSample, Scaled
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import view_subset
from tests.operators.rigs import CONE

GRID = Grid.centred(6, spacing=10.0)


@pytest.fixture
def rig():
    return replace(CONE, source=CONE.source.clone())


def counted(of, key=()):
    """Number of computations in three calls."""
    made = []
    for _ in range(3):
        kept(of, key, lambda: made.append(1))
    return len(made)


def test_a_value_is_computed_once_for_each_object_and_key(rig):
    other = rig[:]
    for of in (rig, other, GRID, torch.zeros(2), RayTransform(GRID, rig)):
        assert (counted(of), counted(of), counted(of, "another")) == (1, 0, 1)
    places = [place(torch.zeros(1, device=device)) for device in ("cpu", "meta")]
    assert [counted(rig, one) for one in places] == [1, 1]


CHANGES = {
    "in place": lambda x: x.mul_(2),
    "data": lambda x: setattr(x, "data", 2 * x),
    "data in place": lambda x: x.data.mul_(2),
    "NumPy": lambda x: np.multiply(x.numpy(), 2, out=x.numpy()),
    "set": lambda x: x.set_(2 * x),
    "gradient": lambda x: x.requires_grad_(),
}


@pytest.mark.parametrize(
    ("memory", "change"),
    [(m, c) for m in ("torch", "NumPy") for c in CHANGES]
    + [("inference", c) for c in CHANGES][:-1],
)
def test_a_changed_tensor_is_seen(memory, change):
    if memory == "inference":
        with torch.inference_mode():
            x = torch.ones(3)
    else:
        x = torch.from_numpy(np.ones(3)) if memory == "NumPy" else torch.ones(3)
    if memory == "torch":
        x.numpy()  # as a kernel has
    value = partial(kept, x, "double", lambda: 2 * x.detach())
    value()
    with torch.inference_mode(memory == "inference"):
        CHANGES[change](x)
    assert torch.equal(value(), 2 * x)
    assert (counted(x) == 3) == x.requires_grad


class Plain(LinearOperator):
    """A user's operator, with attributes of every kind."""

    domain_shape = range_shape = (2,)

    def __init__(self):
        self.factor, self.table, self.inner = 1.0, np.ones(2), Scaled(RayTransform(GRID, CONE))
        self.option, self.response = {"name": ["a"]}, Response()
        weight = torch.ones(2)
        self.scale = lambda x: x * weight
        self.bound, self.calls, self.last_result = self.response.apply, (Response(),), None
        self.weight = weight

    def forward(self, x):
        self.last_result = x
        return self.scale(x)


class Response:
    def __init__(self):
        self.gain = torch.ones(2)

    def apply(self, x):
        return self.gain * x


ATTRIBUTES = {
    "number": lambda A: setattr(A, "factor", 2.0),
    "array": lambda A: A.table.__imul__(2),
    "another array": lambda A: setattr(A, "table", np.zeros(2)),
    "closure": lambda A: A.weight.mul_(2),
    "function": lambda A: setattr(A, "scale", lambda x: 2 * x),
    "option": lambda A: A.option["name"].append("b"),
    "object": lambda A: A.response.gain.mul_(2),
    "object's tensor": lambda A: setattr(A.response, "gain", torch.zeros(2)),
    "object in a tuple": lambda A: A.calls[0].gain.mul_(2),
    "inner operator": lambda A: setattr(A, "inner", Scaled(RayTransform(GRID, CONE[[0]]))),
    "inner tensor": lambda A: setattr(A.inner, "voxels", torch.ones(6, 6, 6)),
    "added": lambda A: setattr(A, "more", 1),
}


@pytest.mark.parametrize("change", ATTRIBUTES.values(), ids=ATTRIBUTES)
def test_a_changed_attribute_is_seen_and_a_report_of_the_last_call_is_none(change):
    A = Plain()
    before = contents(A)
    assert counted(A) == 1
    A(torch.ones(2))
    assert counted(A) == 0 and contents(A) == before
    change(A)
    assert counted(A) == 1 and contents(A) != before


def test_an_operator_within_one_that_is_no_module_is_seen():
    mu = torch.ones(6, 6, 6)
    whole = RayTransform(GRID, CONE, support=mu > 0)
    A = Scaled(view_subset(whole, [0, 2]), voxels=mu)
    assert counted(A) == 1
    whole.support[0] = False
    assert counted(A) == 1 and counted(A.T) == 1


def test_the_order_of_shared_parts_is_seen():
    one, other = (RayTransform(GRID, CONE, method=method) for method in ("joseph", "siddon"))
    A = PerSample([one, other, one])
    first = contents(A)
    assert counted(A) == 1
    A.operators[2] = other
    assert counted(A) == 1 and contents(A) != first


def test_contents_are_those_of_equal_operators_and_of_no_others():
    def build(**options):
        return Scaled(RayTransform(Grid.centred(6, spacing=10.0), CONE[:], **options))

    A = build()
    assert contents(A) == contents(build()) == contents(deepcopy(A))
    support = torch.ones(6, 6, 6, dtype=torch.bool)
    others = [
        build(method="siddon"),
        build(rays_per_pixel=2),
        build(support=support),
        Scaled(RayTransform(Grid.centred(6, spacing=9.0), CONE)),
        Scaled(RayTransform(Grid.centred(6, spacing=10.0, centre=(1.0, 0, 0)), CONE)),
        Scaled(RayTransform(GRID, CONE[[1, 0, *range(2, len(CONE))]])),
        2.0 * RayTransform(GRID, CONE),
        Scaled(RayTransform(GRID, CONE), voxels=torch.ones(6, 6, 6)),
        Scaled(RayTransform(GRID, CONE), lambda: torch.full((1,), 2.0)),
        A.T,
    ]
    assert len({contents(one) for one in (A, *others)}) == 1 + len(others)
    x, y = torch.zeros(2, 3), torch.zeros(3, 2)
    assert len({contents(each) for each in (x, y, x.double(), x.bool())}) == 4


def test_a_copy_has_values_of_its_own(rig):
    A = RayTransform(GRID, rig)
    counted(A)
    for copied in (deepcopy(A), A.with_support(None)):
        assert counted(copied) == 1
    assert counted(A) == 0


def test_values_cached_in_evaluation_support_derivatives_in_training(rig):
    with torch.inference_mode():
        kept(rig, "ones", lambda: torch.ones(3))
    ones = kept(rig, "ones", lambda: None)
    x = torch.ones(3, requires_grad=True)
    assert (x * ones).sum().backward() is None and x.grad is not None


def test_values_of_cameras_with_a_gradient_have_a_graph(rig):
    A = RayTransform(GRID, rig)
    assert counted(A) == 1
    rig.source.requires_grad_()
    assert counted(A) == 3 and kept(A, "source", lambda: 2 * rig.source).requires_grad


def test_a_value_is_released_with_its_object_and_its_id_is_free():
    for size in range(20):  # Python gives the same id again and again
        tensor = torch.full((3,), float(size))
        assert kept(tensor, "sum", tensor.sum) == 3 * size
    value = torch.ones(1)
    A = Scaled(RayTransform(GRID, CONE))
    kept(A, "value", lambda: value)
    gone, count = weakref.ref(A), len(memo._results)
    del A
    gc.collect()
    assert gone() is None and len(memo._results) < count


def test_grids_are_distinguished_by_the_positions_of_their_voxels():
    grids = [Grid.centred(4, spacing=s, centre=(c, 0, 0)) for s in (1.0, 2.0) for c in (0.0, 1.0)]
    assert len({grid_key(grid) for grid in grids}) == 4
    assert grid_key(Grid.centred(4, spacing=1.0)) == grid_key(grids[0])


SUPPORTS = {
    "own, in place": lambda A, mask: mask.logical_not_(),
    "in place": lambda A, mask: A.support.logical_not_(),
    "other": lambda A, mask: setattr(A, "support", ~A.support),
    "NumPy": lambda A, mask: np.logical_not(mask.numpy(), out=mask.numpy()),
}


@pytest.mark.parametrize("change", SUPPORTS.values(), ids=SUPPORTS)
def test_a_changed_support_is_followed(change):
    mask = torch.zeros(GRID.shape, dtype=torch.bool)
    mask[1:3] = True
    A, x = RayTransform(GRID, CONE, support=mask), torch.rand(1, 1, *GRID.shape)
    y = A(x)
    change(A, mask)
    B = RayTransform(GRID, CONE, support=A.support.clone())
    assert torch.equal(A(x), B(x)) and torch.equal(A.T(y), B.T(y)) and not torch.equal(A(x), y)


def test_a_projector_of_a_changed_grid_is_refused():
    A = RayTransform(Grid.centred(6, spacing=10.0), CONE)
    x = torch.rand(1, 1, *GRID.shape)
    A(x)
    with pytest.raises(AttributeError):
        A.grid = GRID
    A.grid.affine.mul_(2)
    with pytest.raises(RuntimeError, match="changed in place after"):
        A(x)


@pytest.mark.parametrize(
    ("one", "other"), [([[1], 2], [[1, 2]]), ({"a": [1], "b": 2}, {"a": [1, "b", 2]})]
)
def test_contents_tell_where_a_container_ends(one, other):
    assert contents(one) != contents(other)
