import math

import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid
from mvrecon_spect.scenes.attenuating import attenuated_integrals
from mvrecon_spect.scenes.cardiac import RandomCardiac

GRID = Grid.centred((64, 64, 64), 5.0, centre=(40, -40, 0))


def points(*places):
    return torch.tensor(places, dtype=torch.float64)


def ball(radius, value, centre=(0, 0, 0)):
    size = torch.full((1, 3), float(radius))
    return Phantom((Solids("ellipsoid", points(centre), torch.eye(3)[None], size, points(value)),))


def test_the_central_ray_of_a_uniform_ball_matches_the_closed_form():
    """(1 - exp(-2 R mu)) / mu: 62.09 mm for R = 100 mm of water."""
    start, end = points((300, 0, 0)), points((-300, 0, 0))
    depth = attenuated_integrals(ball(100, 1.0), ball(100, 0.01536), start, end)
    assert depth.item() == pytest.approx((1 - math.exp(-200 * 0.01536)) / 0.01536, rel=1e-12)
    assert depth.item() == pytest.approx(62.09, abs=5e-3)


def test_matter_attenuates_emission_behind_it_towards_increasing_w():
    start, end = points((300, 0, 0)), points((-300, 0, 0))
    near = ball(10, 0.05, (-50, 0, 0))  # on the way to w = 1
    source = ball(10, 1.0)
    weakened = attenuated_integrals(source, near, start, end).item()
    assert weakened == pytest.approx(20 * math.exp(-20 * 0.05), rel=1e-12)
    assert attenuated_integrals(source, near, end, start).item() == pytest.approx(20)
    ahead = attenuated_integrals(source, near, start, end, (0.0, 0.52))
    assert ahead.item() == pytest.approx(20)  # the ray ends before the matter


def test_rays_of_a_patient_equal_sums_of_small_steps():
    scene = RandomCardiac(defects=1.0)
    activity, matter = (f(generator(0, 4), GRID) for f in (scene.phantom, scene.matter))
    rng = torch.Generator().manual_seed(1)
    start = torch.randn(12, 3, generator=rng, dtype=torch.float64) * 15
    direction = torch.nn.functional.normalize(torch.randn(12, 3, generator=rng).double(), dim=-1)
    start, end = start - 400 * direction, start + 400 * direction
    steps = 4000
    t = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    places, step = start[:, None] + t[:, None] * (end - start)[:, None], 800 / steps
    emission, mu = activity.values(places) * step, matter.values(places) * step
    beyond = mu.flip(1).cumsum(dim=1).flip(1) - mu / 2
    sums = (emission * torch.exp(-beyond)).sum(dim=1)
    exact = attenuated_integrals(activity, matter, start, end)
    assert torch.allclose(exact, sums, rtol=5e-3, atol=0.2)
    nothing = Phantom(tuple(part for part in matter.parts if False))
    plain = attenuated_integrals(activity, nothing, start, end)
    assert torch.allclose(plain, activity.integrals(start, end), rtol=1e-12, atol=1e-9)
    assert (exact < plain).all()
