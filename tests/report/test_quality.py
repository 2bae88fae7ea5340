"""Error estimates of a method: metrics of a scene, ranks over scenes, verdicts."""

import math

import pytest
import torch

from mvrecon.methods.method import Reconstruction
from mvrecon.report.cameras import little_weight
from mvrecon.report.quality import quality_of, quality_row, rank_correlation, sentence


def scene(error: float) -> tuple[Reconstruction, dict]:
    """A volume that is wrong by 1 and 3 of `error`, half of it each, with a sigma of 1.5."""
    truth = torch.ones(1, 1, 4, 4, 4)
    wrong = torch.full_like(truth, error)
    wrong[..., :2] *= 3
    views = torch.ones(1, 1, 2, 4, 4)
    estimates = torch.stack([truth + error, truth - error], dim=1)
    out = Reconstruction(
        truth + wrong,
        sigma=torch.full_like(truth, 1.5 * error),
        per_view=estimates,
        weights=torch.full_like(estimates, 0.5),
        predictions=views[..., :2, :2] * (1 + error),
        binned_views=views[..., :2, :2],
    )
    return out, {"volume": truth, "inside": truth > 0, "views": views}


def test_figures_of_a_scene():
    out, case = scene(0.1)
    figures = quality_of(out, case)
    # errors of 0.7 and 2 sigma
    assert figures["coverage_68"] == 0.5 and figures["coverage_95"] == 1
    assert figures["predicted_nrmse"] == pytest.approx(float(0.15 * 8 / out.volume.norm()))
    assert figures["per_view_spread"] == pytest.approx(0.1, rel=1e-4)
    assert figures["cross_view_nrmse"] == pytest.approx(0.1, rel=1e-4)
    assert quality_of(Reconstruction(out.volume), case) == {}


def test_weights_identify_wrong_cameras_inside_the_object():
    """Camera 2 counts nothing at the object's only voxel, and most beside it."""
    volume, weights = torch.zeros(1, 1, 2, 2, 2), torch.ones(1, 3, 1, 2, 2, 2)
    volume[..., 1] = 2.0
    weights[:, 2, ..., 0], weights[:, 2, ..., 1], weights[:, 1, ..., 1] = 8.0, 0.0, 3.0
    out = Reconstruction(volume, weights=weights / weights.sum(dim=1, keepdim=True))
    assert out.camera_weights.tolist() == [[0.25, 0.75, 0.0]]
    case = {"wrong": torch.tensor([[False, False, True]])}
    assert quality_of(out, case) == {"wrong_cameras_auc": 1.0}
    assert quality_of(out, {"wrong": ~case["wrong"]}) == {"wrong_cameras_auc": 0.0}
    (line,) = little_weight(out.camera_weights[0].tolist())
    assert line.startswith("camera 2: the network gives it a weight of 0.000 (equal: 0.333)")
    assert little_weight([]) == []


def test_ranks_over_the_scenes_and_words():
    errors = (0.1, 0.3, 0.2, 0.4)
    scores = [{"nrmse": e, "view_nrmse": 1 - e, "quality": quality_of(*scene(e))} for e in errors]
    row = quality_row(scores)["quality"]
    assert row["predicted_nrmse"]["rank"] == pytest.approx(1, abs=1e-4)
    assert row["view_nrmse"] == {"rank": pytest.approx(-1, abs=1e-4)}
    assert "rank" not in row["coverage_68"] and len(row["coverage_68"]["values"]) == 4
    words = sentence(row)
    assert words.startswith(
        "intervals of 68 % and 95 % cover 50.0% and 100.0% of the voxels inside"
    )
    assert "sigma 1.00, spread of per-view estimates 1.00" in words and words.endswith(
        "view NRMSE -1.00"
    )
    plain = [{"nrmse": e, "view_nrmse": e} for e in errors]
    assert sentence(quality_row(plain)["quality"]) == ""


def test_two_scenes_or_a_nan_have_no_rank():
    assert rank_correlation([1.0, 3.0, 2.0], [1.0, 3.0, 2.0]) == pytest.approx(1, abs=1e-4)
    assert math.isnan(rank_correlation([1.0, 2.0], [1.0, 2.0]))
    assert math.isnan(rank_correlation([1.0, 2.0, math.inf], [1.0, 2.0, 3.0]))
