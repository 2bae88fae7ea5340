"""What a method tells of its own error, without the truth, for `results.json`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mvrecon.methods.reconstruction import Reconstruction
from mvrecon.report.metrics import auc, coverage, mean_and_spread, nrmse, per_view_spread
from mvrecon.training.losses import binned_like

#: Percent of the voxels that intervals should cover.
SHARES = (68, 95)
#: Figures that a method has without the truth, and how a line of words calls them.
WITHOUT_TRUTH = {
    "predicted_nrmse": "sigma",
    "per_view_spread": "spread of per-view estimates",
    "cross_view_nrmse": "views predicted by the other cameras",
    "view_nrmse": "view NRMSE",
}


def quality_of(out: Reconstruction, scene: Mapping[str, Any]) -> dict[str, float]:
    """What a reconstruction tells of its own error, without a unit: the NRMSE that its standard
    deviation predicts, the spread of its per-view estimates, and how well these predict the other
    cameras' views; how many of the voxels inside the object its intervals cover; and the AUC by
    which the weights of its cameras tell those whose views are wrong.
    """
    figures = {}
    if out.sigma is not None:
        figures["predicted_nrmse"] = nrmse(out.volume + out.sigma, out.volume)
        inside = scene["inside"]
        off = (out.volume - scene["volume"])[inside], out.sigma[inside]
        figures |= {f"coverage_{share}": coverage(*off, share / 100) for share in SHARES}
    if out.per_view is not None and out.weights is not None:
        figures["per_view_spread"] = per_view_spread(out.per_view, out.weights)
    if out.camera_weights is not None and "wrong" in scene:
        figures["wrong_cameras_auc"] = auc(-out.camera_weights, scene["wrong"])
    if out.predictions is not None:
        views = binned_like(scene["views"], out.predictions).expand_as(out.predictions)
        figures["cross_view_nrmse"] = nrmse(out.predictions, views)
    return figures


def quality_row(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Every figure over the scenes; of those without the truth also "rank", Spearman's correlation
    with the true NRMSE (nan for fewer than three scenes).
    """
    figures = [{**score.get("quality", {}), "view_nrmse": score["view_nrmse"]} for score in scores]
    errors, row = [score["nrmse"] for score in scores], {}
    failed = any(map(math.isnan, errors))
    for name in figures[0]:
        values = [figure[name] for figure in figures]
        row[name] = {} if name == "view_nrmse" else mean_and_spread(values, failed)
        if name in WITHOUT_TRUTH:
            row[name]["rank"] = rank_correlation(values, errors)
    return {"quality": row}


def rank_correlation(values: Sequence[float], others: Sequence[float]) -> float:
    """Spearman's rank correlation, without a unit; nan for fewer than three pairs, or where one is
    no number.
    """
    from torchmetrics.functional.regression import spearman_corrcoef  # slow to import

    pair = torch.tensor([values, others], dtype=torch.float64)
    if pair.shape[1] < 3 or not pair.isfinite().all():
        return math.nan
    return spearman_corrcoef(pair[0], pair[1]).item()


def sentence(quality: Mapping[str, Any]) -> str:
    """A line of words: the coverage of the intervals where there are any, and the ranks; empty
    where there is nothing but the view NRMSE.
    """
    if not quality.keys() - {"view_nrmse"}:
        return ""
    parts = []
    if "coverage_68" in quality:
        covered = " and ".join(f"{quality[f'coverage_{share}']['mean']:.1%}" for share in SHARES)
        parts.append(f"intervals of 68 % and 95 % cover {covered} of the voxels inside")
    if "wrong_cameras_auc" in quality:
        area = quality["wrong_cameras_auc"]["mean"]
        parts.append(f"weights of cameras tell which views are wrong, AUC {area:.3f}")
    ranks = {WITHOUT_TRUTH[k]: q["rank"] for k, q in quality.items() if "rank" in q}
    known = [f"{name} {rank:.2f}" for name, rank in ranks.items() if not math.isnan(rank)]
    if known:
        parts.append(f"rank correlation with the true NRMSE: {', '.join(known)}")
    return "; ".join(parts)
