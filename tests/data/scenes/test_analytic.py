import math

import pytest
import torch

from mvrecon.core.numbers import generator, mixed
from mvrecon.core.parts import SCENES
from mvrecon.data.scenes.analytic import render
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import Grid

ENDLESS = ["ellipsoids", "derenzo"]


@pytest.mark.parametrize("name", [*ENDLESS, "shepp_logan"])
def test_a_sample_has_the_documented_format(name, grid, rig):
    scene = SCENES.build(name, value=0.02)
    sample = scene.sample(0, 3, grid, rig)
    assert sample.views.shape == (1, 2, 72, 72) and sample.views.dtype == torch.float32
    assert sample.volume.shape == sample.inside.shape == (1, 24, 24, 24)
    assert sample.volume.dtype == torch.float32 and sample.inside.dtype == torch.bool
    assert sample.name == f"{name}-3-0"
    assert scene.data_range == 0.02
    assert 0 <= sample.volume.min() + 1e-9 and sample.volume.max() <= 0.02 * (1 + 1e-6)
    assert (sample.views >= -1e-6).all() and sample.views.max() > 0.1
    assert (sample.volume[~sample.inside] == 0).all() and 0.01 < sample.inside.float().mean() < 0.6


@pytest.mark.parametrize("name", [*ENDLESS, "shepp_logan"])
def test_views_and_volume_show_the_same_object(name, grid, rig):
    """Each view of a parallel beam holds the whole mass, and its profiles are the volume's sums
    along the rays.
    """
    sample = SCENES.build(name).sample(0, 1, grid, rig)
    along_x = sample.volume[0].sum(dim=2) * 5  # rows z, columns y
    along_y = sample.volume[0].sum(dim=1) * 5  # rows z, columns x
    views = torch.nn.functional.avg_pool2d(sample.views[0], 3)  # 3 x 3 rays meet each voxel
    for view, sums in zip(views, (along_x, along_y), strict=True):
        assert view.sum().item() == pytest.approx(sums.sum().item(), rel=0.05)
        assert torch.corrcoef(torch.stack([view.flatten(), sums.flatten()]))[0, 1] > 0.97


@pytest.mark.parametrize("name", ENDLESS)
def test_a_case_depends_on_seed_and_index_alone(name, grid, rig):
    scene = SCENES.build(name)
    forth = [scene.sample(i, 5, grid, rig) for i in range(3)]
    torch.manual_seed(99)
    back = [SCENES.build(name).sample(i, 5, grid, rig) for i in (2, 1, 0)][::-1]
    for a, b in zip(forth, back, strict=True):
        assert (
            torch.equal(a.views, b.views) and torch.equal(a.volume, b.volume) and a.name == b.name
        )
    assert not torch.equal(forth[0].volume, forth[1].volume)
    assert not torch.equal(forth[0].volume, scene.sample(0, 6, grid, rig).volume)


@pytest.mark.parametrize("name", ENDLESS)
def test_the_random_state_of_torch_does_not_change(name, grid, rig):
    state = torch.get_rng_state()
    SCENES.build(name).sample(0, 0, grid, rig)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("name", ENDLESS)
def test_the_object_is_inside_the_field_of_view(name, rig):
    grid = Grid.centred(size=(40, 30, 20), spacing=(3.0, 4.0, 5.0), centre=(10, -20, 30))
    scene = SCENES.build(name)
    radius = scene.radius(grid)
    assert radius == pytest.approx(scene.field * 100)
    rng = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(
        torch.randn(4000, 3, generator=rng, dtype=torch.float64), dim=-1
    )
    for index in range(8):
        phantom = scene.phantom(generator(0, index), grid)
        assert (phantom.values(grid.centre + direction * radius * 1.0001) == 0).all()
        assert (phantom.values(grid.centre + direction * radius * 0.6) != 0).any()


def test_cases_have_independent_random_numbers():
    assert len({mixed(seed, index) for seed in range(20) for index in range(5000)}) == 100_000
    starts = sorted(seed * 0x9E3779B9 % 2**32 for seed in range(1000))
    gaps = [b - a for a, b in zip(starts, starts[1:] + [starts[0] + 2**32], strict=True)]
    assert min(gaps) > 10**6


def test_the_mask_contains_values_that_cancel(grid, rig):
    shell = Solids(
        "ellipsoid",
        torch.zeros(2, 3),
        torch.eye(3).repeat(2, 1, 1),
        torch.tensor([[40.0] * 3, [30.0] * 3]),
        torch.tensor([1.0, -1.0]),
    )
    sample = render(Phantom((shell,)), grid, rig, "shell")
    assert sample.volume[0, 12, 12, 12] == 0 and sample.inside[0, 12, 12, 12]
    assert not sample.inside[0, 0, 0, 0]


def test_views_follow_the_limits_of_the_rig(grid, rig):
    scene = SCENES.build("ellipsoids")
    whole = scene.sample(0, 0, grid, rig).views
    rig.ray_extent = (-math.inf, 0.5)
    first = scene.sample(0, 0, grid, rig).views
    rig.ray_extent = (0.5, math.inf)
    second = scene.sample(0, 0, grid, rig).views
    torch.testing.assert_close(first + second, whole, atol=1e-4, rtol=1e-5)
    assert first.sum() > 0 and second.sum() > 0


@pytest.mark.parametrize("name", [*ENDLESS, "shepp_logan"])
@pytest.mark.parametrize(
    "options", [{"field": 0.0}, {"field": 0.6}, {"value": 0.0}, {"value": -1.0}]
)
def test_invalid_options_are_refused(name, options):
    with pytest.raises(ValueError, match=f"got {next(iter(options.values()))}"):
        SCENES.build(name, **options)


def test_negative_seeds_and_indices_are_refused(grid, rig):
    for index, seed in ((-1, 0), (0, -1)):
        with pytest.raises(ValueError, match=f"got seed {seed}, index {index}"):
            SCENES.build("ellipsoids").sample(index, seed, grid, rig)
