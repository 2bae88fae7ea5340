"""Networks in the world that see the box around each sample's support alone."""

import pytest
import torch
from mvrecon.models.cross_view.model import CrossView

from tests.models.cross_view.test_model import SMALL, stirred
from tests.models.rig import small_projector


@pytest.mark.filterwarnings("ignore:Rays are up to")
@torch.no_grad()
def test_a_crop_is_each_sample_s_own_and_of_the_whole_grid_it_changes_nothing():
    projector = small_projector(size=32, pixels=32)
    volume = torch.zeros(2, 1, 32, 32, 32)
    volume[0, :, 12:17, 12:17, 13:18] = 1.0
    volume[1, :, 8:20, 14:20, 4:18] = 1.0
    views, model = projector(volume), stirred(projector, support="hull", crop=True)
    shapes = []
    model.rounds[-1].world.register_forward_hook(
        lambda net, args, out: shapes.append(out.shape[2:])
    )
    both = model(views).volume
    assert len(set(shapes)) == 2 and min(shape.numel() for shape in shapes) < 32**3
    for own, alone in zip(both.split(1), views.split(1), strict=True):
        assert (model(alone).volume - own).abs().max() < 1e-5 * own.abs().max()
    everywhere = projector(torch.ones(1, 1, 32, 32, 32))
    cropped = model(everywhere).volume
    model.crop = False
    assert torch.equal(model(everywhere).volume, cropped)


def test_a_crop_needs_a_support():
    with pytest.raises(ValueError, match="got crop=True and support='none'"):
        CrossView(small_projector(), SMALL["M3"], crop=True)
