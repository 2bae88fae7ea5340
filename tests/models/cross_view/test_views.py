"""What the cameras' networks look at: samples along rays, and cells of pixels."""

import torch
from mvrecon.models.cross_view.sampling import RaySamples
from mvrecon.models.cross_view.views import Binned, among_counts, means

from mvrecon.models.frusta import Frusta
from mvrecon.parts import PROJECTORS
from tests.models.rig import small_projector, small_rig


def test_samples_along_rays_are_those_of_the_frusta():
    grid, cameras = small_rig()
    samples, frusta = RaySamples(grid, cameras, 5), Frusta.of(grid, cameras, 5)
    volumes = torch.rand(2, 3, *grid.shape)
    assert torch.equal(samples(volumes), frusta.to_frusta(volumes[:, None]))
    assert samples.double().maps.dtype == samples.half().maps.dtype == torch.float64


def test_a_cell_beyond_the_detector_is_where_its_pixels_would_be():
    """So a cell is in the same place as that of a detector which the cells fill."""
    whole = Binned.of(small_projector(pixels=12), 3).cameras
    grid, cameras = small_rig(pixels=12)
    less = PROJECTORS.build("drr", grid=grid, cameras=cameras.cropped((0, 11), (0, 10)))
    assert torch.equal(Binned.of(less, 3).cameras.rays()[1], whole.rays()[1])
    views = torch.rand(1, 1, 4, 11, 10)
    expected = views[..., 9:11, 9:].mean(dim=(-2, -1))
    assert torch.allclose(means(views, 3)[..., -1, -1], expected)


def test_most_pixels_beside_the_object_are_empty_and_few_in_it():
    """A stray count is for itself; an empty pixel among counts is one of them, by the edge not."""
    counts = torch.zeros(1, 1, 1, 8, 8)
    counts[..., 1, 6] = 1
    counts[..., 3:, :4] = 5
    counts[..., 5, 2] = 0
    seen = among_counts(counts)[0, 0, 0]
    assert seen[1, 6] and seen[3:, :4].all() and seen.sum() == 1 + 5 * 4
