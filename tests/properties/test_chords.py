"""Volumes of ones: what an operator sees of them is the length of its rays, found here by another
way.
"""

import math

import pytest
import torch
from hypothesis import given, strategies as st

from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.grid import Grid
from tests.operators.cases import Case
from tests.properties.rays import allowed, course, faded
from tests.properties.strategies import DTYPES, METHODS, cases, epsilon, volumes

ANY = {"case": cases(), "dtype": st.sampled_from(DTYPES)}


def ones(case: Case, dtype: torch.dtype) -> torch.Tensor:
    return torch.ones(1, 1, *case.grid.shape, dtype=dtype)


@given(**ANY)
def test_siddon_measures_the_chord(case, dtype):
    seen, chord = case.build(method="siddon")(ones(case, dtype))[0, 0].double(), course(case).length
    apart, steady = allowed(case, ones(case, dtype), dtype)
    assert ((seen - chord).abs() <= apart)[steady].all()


@given(**ANY)
def test_joseph_sees_the_chord_of_a_ray_between_the_outermost_centres(case, dtype):
    """There its weights sum to one in every slab; elsewhere the ones fade to zero over one voxel,
    and it sees less.
    """
    seen, through = case.build(method="joseph")(ones(case, dtype))[0, 0].double(), course(case)
    apart, steady = allowed(case, ones(case, dtype), dtype)
    way = (through.last - through.first).abs()
    main = way.argmax(dim=-1, keepdim=True)
    sizes = torch.tensor(case.grid.shape[::-1], dtype=torch.float64) - 1
    # half a slab further on at both ends: the places that are read lie in the middle of slabs
    step = (through.last - through.first) / way.amax(dim=-1, keepdim=True).clamp_min(1e-300)
    ends = torch.stack([through.first - step / 2, through.last + step / 2])
    held = ((ends >= 0) & (ends <= sizes)).all(dim=0)
    held = held.scatter(-1, main, True).all(dim=-1) & steady & (through.length > 0)
    assert ((seen - through.length).abs() <= apart)[held].all()


@given(**ANY)
def test_joseph_sees_ones_that_fade_over_a_voxel(case, dtype):
    """Every ray, those beside the box too."""
    seen = case.build(method="joseph")(ones(case, dtype))[0, 0].double()
    apart, steady = allowed(case, ones(case, dtype), dtype)
    assert ((seen - faded(case)).abs() <= apart)[steady].all()


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_joseph_sees_a_ray_beside_the_box_by_the_middles_of_its_slabs(backend):
    """Shrunk: a ray that begins behind the middle, where it is more than half a voxel beyond the
    box already.
    """
    ends = torch.tensor([[0.2, 1.06, 0.0], [1.2, 1.86, 0.0]], dtype=torch.float64).reshape(
        2, 1, 1, 1, 3
    )
    case = Case(Grid.centred((1, 1, 1), 1.0), ExplicitRays(*ends))
    seen = case.build(backend=backend)(ones(case, torch.float64)).item()
    assert course(case, grown=0.5).length.item() == 0
    # it has 0.3 of a slab left, and in the slab's middle it is 0.9 voxels from the centre
    assert seen == pytest.approx(0.3 * (1 - 0.9) * math.hypot(1, 0.8), rel=1e-12)


def reached(case: Case, method: str) -> torch.Tensor:
    """The length, in mm, over which a ray sees a volume: least bounds for siddon and joseph, since
    ones attain them.
    """
    if method == "joseph":
        return faded(case)
    return course(case, grown=0.0 if method == "siddon" else 0.5).length


@given(**ANY, method=st.sampled_from(METHODS), data=st.data())
def test_a_mean_lies_between_zero_and_the_greatest_value(case, dtype, method, data):
    """P7: 0 <= A x <= max x times what is seen of ones, or the length in which any trilinear sample
    can lie.
    """
    x = data.draw(volumes(case.grid.shape, dtype, signed=False))
    views = case.build(method=method)(x).double()
    most = x.double().amax(dim=(2, 3, 4))[:, :, None, None, None] * reached(case, method)
    apart, steady = allowed(case, x, dtype)
    assert (views >= 0).all() and ((views <= most + apart) | ~steady).all()


@given(**ANY)
def test_trilinear_sees_the_way_between_the_outermost_centres(case, dtype):
    """All samples there are one; those beyond are less, and each stands for an equal share of the
    longer way.
    """
    seen = case.build(method="trilinear:40")(ones(case, dtype))[0, 0].double()
    inner, grown = course(case, inner=True).length, course(case, grown=0.5).length
    apart, steady = allowed(case, ones(case, dtype), dtype)
    least = (inner - grown / 40) * (1 - 100 * epsilon(dtype))
    assert ((seen >= least - apart) & (seen <= grown + apart))[steady].all()
