import pytest
import torch

from mvrecon.core.numbers import generator
from mvrecon.data.scenes.phantoms import RandomEllipsoids


@pytest.mark.parametrize("seed", range(20))
def test_values_are_in_range_and_the_body_contains_everything(seed, grid):
    scene = RandomEllipsoids(count=(12, 12), value=3.0)
    (solids,) = scene.phantom(generator(seed, 0), grid).parts
    phantom = scene.phantom(generator(seed, 0), grid)
    rng = torch.Generator().manual_seed(seed)
    xyz = (torch.rand(20_000, 3, generator=rng, dtype=torch.float64) - 0.5) * 100
    values = phantom.values(xyz)
    assert values.min() >= -1e-12 and values.max() <= 3 + 1e-12
    body, xyz = phantom.support().values(xyz) > 0, (xyz - solids.centres[0]) @ solids.rotations[0]
    assert torch.equal(body, ((xyz / solids.semi_axes[0]) ** 2).sum(dim=-1) <= 1)
    assert (values[body] > 0).all()


def test_some_are_higher_and_some_lower_than_the_body(grid):
    values = torch.cat(
        [RandomEllipsoids().phantom(generator(0, i), grid).parts[0].values[1:] for i in range(20)]
    )
    assert (values > 0).float().mean() > 0.3 and (values < 0).float().mean() > 0.2


def test_the_number_of_ellipsoids_is_as_specified(grid):
    counts = {
        len(RandomEllipsoids(count=(2, 4)).phantom(generator(1, i), grid).parts[0].values) - 1
        for i in range(40)
    }
    assert counts == {2, 3, 4}
    assert len(RandomEllipsoids(count=(0, 0)).phantom(generator(1, 0), grid).parts[0].values) == 1


@pytest.mark.parametrize(
    "options",
    [
        {"count": (5, 3)},
        {"count": (-1, 3)},
        {"count": (3,)},
        {"sizes": (0.0, 0.4)},
        {"sizes": (0.4, 0.1)},
    ],
)
def test_invalid_options_are_refused(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}.*got"):
        RandomEllipsoids(**options)
