"""Values cached beside an operator, a rig or a tensor follow everything that determines them.

Ways of changing a tensor that were tried: assignment, in-place operations, `.data =`,
`.data.copy_`, `.numpy()`, memory given by NumPy, and inference tensors. Ways of changing an
operator: tensors of its own, of an operator that is not a module within it, of a record or plain
object, with slots or none, of a closure or a global variable, also one that only a comprehension
or a function within another names; NumPy arrays, of objects too, and Python's; containers and
classes derived from them; bound methods, of Python and of C; weak references; hooks of modules,
TorchScript; sparse, complex and conjugate tensors, NaN; options, by type as by value; another
operator in its place.
"""

import gc
import weakref
from array import array
from collections import deque
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.fdk import fdk
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


class Holder(LinearOperator):
    domain_shape = range_shape = (2,)

    def __init__(self, part):
        self.part = part


class Slotted:
    __slots__ = ("gain",)

    def __init__(self):
        self.gain = torch.ones(2)


@dataclass
class Record:
    number: int = 1

    def __post_init__(self):
        self.gain = torch.ones(2)


class Weights(list):
    def __init__(self):
        super().__init__([1])
        self.gain = torch.ones(2)


GAIN = torch.ones(2)


def scaled(x):
    return GAIN * x


def scaled_within(x):
    return sum((lambda y: GAIN * y)(y) for y in x)


def with_attribute():
    def function(x):
        return function.gain * x

    function.gain = torch.ones(2)
    return function


def frozen():
    with torch.random.fork_rng():
        return torch.nn.Linear(2, 2).requires_grad_(False)


SPARSE = torch.eye(3).to_sparse
PARTS = {
    "slots": (Slotted, lambda part: part.gain.mul_(2)),
    "record": (Record, lambda part: part.gain.mul_(2)),
    "derived list": (Weights, lambda part: part.gain.mul_(2)),
    "function": (with_attribute, lambda part: part.gain.mul_(2)),
    "global": (lambda: scaled, lambda part: GAIN.mul_(2)),
    "global within": (lambda: scaled_within, lambda part: GAIN.mul_(2)),
    "weak reference": (lambda: weakref.ref(GAIN), lambda part: GAIN.mul_(2)),
    "method in C": (lambda: torch.ones(2).mul, lambda part: part.__self__.mul_(2)),
    "method of NumPy": (lambda: np.ones(2).dot, lambda part: part.__self__.fill(2)),
    "deque": (lambda: deque([1]), lambda part: part.append(2)),
    "array": (lambda: array("d", [1]), lambda part: part.append(2)),
    "set": (lambda: {torch.arange(2e3)}, lambda part: next(iter(part))[1000:].mul_(2)),
    "objects": (lambda: np.array([torch.ones(2), 1], object), lambda part: part[0].mul_(2)),
    "hook": (frozen, lambda part: part.register_forward_hook(lambda *args: 2 * args[2])),
    "data": (frozen, lambda part: part.weight.data.mul_(2)),
    "script": (lambda: torch.jit.script(frozen()), lambda part: part.weight.data.mul_(2)),
    "sparse": (lambda: SPARSE(), lambda part: part._values().data.mul_(2)),
    "compressed": (lambda: SPARSE(layout=torch.sparse_csr), lambda x: x.values().data.mul_(2)),
    "conjugate": (lambda: torch.full((2,), 1j).conj(), lambda part: part.mul_(1j)),
    "not a number": (lambda: torch.full((2,), torch.nan), lambda part: part[0].fill_(1)),
    "half": (lambda: torch.ones(2).bfloat16(), lambda part: part.mul_(2)),
    "slice": (lambda: torch.ones(4)[1:3], lambda part: part._base.numpy().fill(2)),
}


@pytest.mark.parametrize(("build", "change"), PARTS.values(), ids=PARTS)
@pytest.mark.filterwarnings("ignore:Sparse .* tensor support is in beta")
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated")
def test_a_changed_part_of_any_kind_is_seen(build, change):
    A = Holder(build())
    before = contents(A)
    assert (counted(A), counted(A)) == (1, 0) and contents(A) == before
    change(A.part)
    assert counted(A) == 1 and contents(A) != before


def test_options_are_told_apart_by_type():
    A = Holder(1)
    assert counted(A) == 1
    for part in (True, 1.0, np.float32(1), -0.0, 0.0, 0, float("nan"), None, "1"):
        A.part = part
        assert counted(A) == 1, part
    A.part = float("nan")
    assert counted(A) == 1
    A.part = float("nan")
    assert counted(A) == 0


def test_a_value_does_not_depend_on_the_precision_of_its_first_caller(rig):
    ones = torch.full((64, 64), 1 / 3)
    with torch.autocast("cpu", torch.bfloat16), torch.inference_mode():
        value = kept(rig, "product", lambda: ones @ ones)
    assert torch.equal(value, ones @ ones)


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


def test_a_rig_is_released_after_filtered_backprojection():
    rig = circular(24, 200.0, 300.0, {"pixels": [6, 6], "pixel_mm": 24.0})
    fdk(RayTransform(GRID, rig), torch.ones(1, 1, 24, 6, 6))
    gone = weakref.ref(rig)
    del rig
    gc.collect()
    assert gone() is None


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


UNSEEN_BY_TORCH = [change for change in CHANGES if change not in ("set", "gradient")]


@pytest.mark.parametrize("inference", [False, True])
@pytest.mark.parametrize("change", UNSEEN_BY_TORCH)
@pytest.mark.parametrize("of", ["grid", "cameras"])
def test_a_projector_of_a_changed_grid_or_rig_is_refused(of, change, inference):
    with torch.inference_mode(inference):
        grid, rig = Grid.centred(6, spacing=10.0), CONE[:]
        rig = replace(rig, source=rig.source.clone())
    A, x = RayTransform(grid, rig), torch.rand(1, 1, *GRID.shape)
    A(x)
    with pytest.raises(AttributeError):
        A.grid = GRID
    with torch.inference_mode(inference):
        CHANGES[change](grid.affine if of == "grid" else rig.source)
    for call in (lambda: A(x), lambda: A.T(A(x)), lambda: deepcopy(A)):
        with pytest.raises(RuntimeError, match="changed in place after"):
            call()


@pytest.mark.parametrize(
    ("one", "other"), [([[1], 2], [[1, 2]]), ({"a": [1], "b": 2}, {"a": [1, "b", 2]})]
)
def test_contents_tell_where_a_container_ends(one, other):
    assert contents(one) != contents(other)
