"""Options of learned methods are checked where a method is built, also in Python."""

from typing import Literal, get_origin

import numpy as np
import pytest
import torch
from torch import nn

from mvrecon.core.parts import METHODS, describe
from mvrecon.core.signatures import alternatives
from mvrecon.methods.method import build_method

#: What each method is built with, if it has such an option.
GIVEN = {"n_cameras": 4, "method": {"name": "world_unet", "widths": [2, 4]}}


def choices():
    """Options of learned methods whose values are a few words."""
    for name in METHODS.names():
        part = describe("method", name)
        for key, option in part.options.items() if part.is_class else ():
            if any(get_origin(member) is Literal for member, _ in alternatives(option.type)):
                yield pytest.param(name, key, id=f"{name}.{key}")


def built(name, **options):
    known = describe("method", name).options
    return build_method({"name": name, **{k: v for k, v in GIVEN.items() if k in known}, **options})


@pytest.mark.parametrize(("name", "key"), choices())
def test_an_unknown_word_is_refused_with_the_known_ones(name, key):
    """precision="bfloat16" computed in float32 in silence; an unknown filter of a network failed in
    its first call.
    """
    with pytest.raises(ValueError, match=rf"{key} must be one of .*, got 'bfloat16'"):
        built(name, **{key: "bfloat16"})


@pytest.mark.parametrize("name", ["cross_view", "world_unet", "mean_fusion"])
@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"name": "cross_view"}, "start.name: expected a classical method, got the learned one"),
        ({"name": "uncertain"}, "start.name: expected a classical method, got the learned one"),
        ({"name": "sirt", "iterations": "many"}, "start.iterations: expected .*, got 'many'"),
        ({"name": "sirt", "iteration": 3}, "no option 'iteration'; did you mean 'iterations'"),
        ({"iterations": 3}, "needs a 'name'"),
        ("sirt", "start: expected .*, got 'sirt'"),
        (None, "start: expected .*, got null"),
        (-1, "start: expected .*, got -1"),
        (1.5, "start: expected .*, got 1.5"),
        (True, "start: expected .*, got True"),
    ],
)
def test_a_start_is_checked_when_its_network_is_built(name, start, message):
    """A learned method as a start failed in the first call, with a word about its own options."""
    with pytest.raises(TypeError, match=message):
        built(name, start=start)


@pytest.mark.parametrize(
    "start",
    [
        0,
        12,
        np.int64(3),
        {"name": "fbp"},
        {"name": "sirt", "iterations": np.int64(2)},
        {"name": "cgls", "monitor": print, "iterations": 2},
        {"name": "mlem", "background": torch.ones(1, 1, 4, 12, 12), "iterations": 2},
    ],
)
def test_a_start_by_number_or_classical_method_is_built(start):
    """Also with values that only Python can give: numbers of NumPy, functions and tensors."""
    assert isinstance(built("world_unet", start=start), nn.Module)
