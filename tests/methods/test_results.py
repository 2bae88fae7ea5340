"""What methods return is checked at every call."""

import numpy as np
import pytest
import torch
from torch import nn

from mvrecon.core.parts import METHODS
from mvrecon.methods.method import Reconstruction, build_method
from tests.methods.learned.rig import small_projector

ODD = {
    "array": lambda x: x.numpy(),
    "nothing": lambda x: None,
    "size": lambda x: x[..., 1:],
    "one volume": lambda x: x[0, 0],
    "channels": lambda x: x.repeat(1, 2, 1, 1, 1),
    "samples": lambda x: x.repeat(2, 1, 1, 1, 1),
    "no sample": lambda x: x[:0],
    "integers": lambda x: x.int(),
    "complex": lambda x: x + 0j,
}


class Odd(nn.Module):
    """A method as a module, whose result is another's."""

    def __init__(self, kind: str = "array", what: str = "volume"):
        super().__init__()
        self.kind, self.what = kind, what

    def forward(self, views, A):
        x = A.T(views)
        if self.what == "result":
            return x
        odd = ODD[self.kind](x)
        return Reconstruction(odd) if self.what == "volume" else Reconstruction(x, sigma=odd)


def odd_function(A, views, kind="array"):
    return ODD[kind](A.T(views))


@pytest.fixture(autouse=True)
def registered():
    METHODS.register("odd_module")(Odd)
    METHODS.register("odd_function")(odd_function)
    yield
    for name in ("odd_module", "odd_function"):
        METHODS._parts.pop(name)


@pytest.mark.parametrize("kind", [kind for kind in ODD if kind != "nothing"])
@pytest.mark.parametrize("what", ["function", "volume", "sigma"])
def test_a_result_that_is_no_volume_of_the_grid_is_refused_by_its_method(kind, what):
    """A second channel or sample was left out of the file in silence; tensors and arrays from a
    module ended in a traceback, and another sigma after the volume was written. Also tried:
    None, tuples, transposed volumes, within `aligned`, float16, float64, gradients, weights.
    """
    A = small_projector()
    views = torch.ones(1, 1, *A.range_shape)
    own = {"name": "odd_function"} if what == "function" else {"name": "odd_module", "what": what}
    for method in ({**own, "kind": kind}, {"name": "aligned", "method": {**own, "kind": kind}}):
        with pytest.raises((TypeError, ValueError), match=f"Expected of {own['name']}"):
            build_method(method)(views, A=A)


def test_a_module_that_returns_a_tensor_is_refused_by_its_name():
    A = small_projector()
    with pytest.raises(TypeError, match="Expected of odd_module a Reconstruction"):
        build_method({"name": "odd_module", "what": "result"})(torch.ones(1, 1, *A.range_shape), A)


@pytest.mark.parametrize("array", [torch.float64, torch.float32])
def test_volumes_of_any_precision_are_results(array):
    A = small_projector()
    views = torch.ones(2, 1, *A.range_shape)
    ODD["right"] = lambda x: torch.as_tensor(np.asarray(x)).to(array)
    volume = build_method({"name": "odd_module", "kind": "right"})(views, A).volume
    assert volume.shape == (2, 1, *A.domain_shape) and volume.dtype == array
