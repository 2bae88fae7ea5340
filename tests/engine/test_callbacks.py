"""What the board shows of a support."""

import copy

import pytest
import torch

from mvrecon.config import compose
from mvrecon.engine import fit
from mvrecon.engine.callbacks import outlined


def test_an_outline_is_the_masks_outermost_voxels():
    volume, mask = torch.rand(7, 7, 7), torch.zeros(7, 7, 7, dtype=torch.bool)
    mask[0:4, 1:5, 2:6] = True
    shown = outlined(volume, mask, 9.0)
    assert torch.equal(shown[1:3, 2:4, 3:5], volume[1:3, 2:4, 3:5])
    assert torch.equal(shown[~mask], volume[~mask])
    assert (shown == 9).sum() == 4**3 - 2**3


@pytest.mark.parametrize("support", ["none", "hull"])
def test_the_board_tells_the_support_at_validation(support, tmp_path):
    settings = copy.deepcopy(compose("experiment=smoke"))
    settings["model"] |= {"support": support}
    settings["trainer"] |= {"max_steps": 2}
    board = {"_target_": "mvrecon.engine.callbacks.BoardReview", "baselines": ["backprojection"]}
    settings["callbacks"] = {"board": board}
    fit.fit("cross_view", settings, fit.build_data(settings), tmp_path)
    header = next(tmp_path.rglob("metrics.csv")).read_text().splitlines()[0]
    assert ("val/support_fraction" in header) == (support == "hull")
    assert (tmp_path / "review" / "planes.png").exists()
