"""A method's own error estimates against the true error: coverage of its intervals, spread of its
per-view estimates, prediction of views, and their rank correlation over the scenes.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.runs import Figure
from mvrecon.data.dataset import Batch
from mvrecon.methods.method import Reconstruction
from mvrecon.report.cameras import CameraEstimates
from mvrecon.report.metrics import auc, mean_and_spread, nrmse

#: Percent of the voxels that intervals should cover.
COVERED_PERCENT = (68, 95)
#: Figures without the truth, and their wording in `sentence`.
WITHOUT_TRUTH = {
    "predicted_nrmse": "sigma",
    "per_view_spread": "spread of per-view estimates",
    "cross_view_nrmse": "views predicted by the other cameras",
    "view_nrmse": "view NRMSE",
}


class Score(CameraEstimates, extra_items=float):
    """Figures of merit of one case by name, with milliseconds and additional bytes of its
    reconstruction and the method's own error estimates.
    """

    ms: float
    bytes: int | None
    quality: dict[str, float]


def coverage(error: Float[Tensor, "*n"], sigma: Float[Tensor, "*n"], share: float) -> float:
    """Share of errors within the interval about zero that nominally contains `share` of them,
    without a unit; nan for no error.

    The interval is that of a Laplace distribution: errors have many small and a few large values,
    at edges, for which a Gaussian's is too wide at 0.68 and too narrow at 0.95.

    Args:
        error: error of each value.
        sigma: its standard deviation, in the same unit.
        share: nominal share of errors, between 0 and 1; 0.68 means |error| <= 0.806 sigma, 0.95
            means 2.118 sigma.
    """
    wide = -math.log(1 - share) / math.sqrt(2)
    return (error.abs() <= wide * sigma).double().mean().item()


def per_view_spread(
    estimates: Float[Tensor, "b m 1 d h w"], weights: Float[Tensor, "b m 1 d h w"]
) -> float:
    """Weighted standard deviation of the per-view estimates relative to their weighted mean, both
    as root mean squares over voxels, without a unit.
    """
    estimates, weights = estimates.double(), weights.double()
    mean = (weights * estimates).sum(dim=1, keepdim=True)
    deviation = (weights * (estimates - mean).square()).sum(dim=1).sqrt()
    size = mean.norm().item()
    return deviation.norm().item() / size if size else 0.0


def quality_of(out: Reconstruction, scene: Batch) -> dict[str, float]:
    """Return a reconstruction's own error estimates, without a unit: the NRMSE predicted by its
    standard deviation, the spread of its per-view estimates and their error in predicting the other
    cameras' views; the coverage of its intervals inside the object; and the AUC of detecting faulty
    views by the weights of its cameras.
    """
    figures = {}
    if out.sigma is not None:
        figures["predicted_nrmse"] = nrmse(out.volume + out.sigma, out.volume)
        inside = scene["inside"]
        off = (out.volume - scene["volume"])[inside], out.sigma[inside]
        figures |= {f"coverage_{share}": coverage(*off, share / 100) for share in COVERED_PERCENT}
    if out.per_view is not None and out.weights is not None:
        figures["per_view_spread"] = per_view_spread(out.per_view, out.weights)
    if out.camera_weights is not None and "wrong" in scene:
        figures["wrong_cameras_auc"] = auc(-out.camera_weights, scene["wrong"])
    if out.predictions is not None and out.binned_views is not None:
        figures["cross_view_nrmse"] = nrmse(out.predictions, out.binned_views)
    return figures


def quality_row(scores: Sequence[Score]) -> dict[str, dict[str, Figure]]:
    """Summarise all figures over the scenes; for those without the truth also "rank", Spearman's
    correlation with the true NRMSE (nan for fewer than three scenes).
    """
    figures = [{**score.get("quality", {}), "view_nrmse": score["view_nrmse"]} for score in scores]
    errors, row = [score["nrmse"] for score in scores], {}
    failed = any(map(math.isnan, errors))
    for name in figures[0]:
        values = [figure.get(name, math.nan) for figure in figures]  # none where a method raised
        row[name] = {} if name == "view_nrmse" else mean_and_spread(values, failed)
        if name in WITHOUT_TRUTH:
            row[name]["rank"] = rank_correlation(values, errors)
    return {"quality": row}


def rank_correlation(values: Sequence[float], others: Sequence[float]) -> float:
    """Spearman's rank correlation, without a unit; nan for fewer than three pairs, or
    with a nan.
    """
    from torchmetrics.functional.regression import spearman_corrcoef  # slow to import

    pair = torch.tensor([values, others], dtype=torch.float64)
    if pair.shape[1] < 3 or not pair.isfinite().all():
        return math.nan
    return spearman_corrcoef(pair[0], pair[1]).item()


def sentence(quality: Mapping[str, Figure]) -> str:
    """Describe the coverage of the intervals, if any, and the ranks; empty for the view
    NRMSE only.
    """
    if not quality.keys() - {"view_nrmse"}:
        return ""
    parts = []
    if "coverage_68" in quality:
        covered = " and ".join(
            f"{quality[f'coverage_{share}']['mean']:.1%}" for share in COVERED_PERCENT
        )
        parts.append(f"intervals of 68 % and 95 % cover {covered} of the voxels inside")
    if "wrong_cameras_auc" in quality:
        area = quality["wrong_cameras_auc"]["mean"]
        parts.append(f"camera weights detect the wrong views with an AUC of {area:.3f}")
    ranks = {WITHOUT_TRUTH[k]: q["rank"] for k, q in quality.items() if "rank" in q}
    known = [f"{name} {rank:.2f}" for name, rank in ranks.items() if not math.isnan(rank)]
    if known:
        parts.append(f"rank correlation with the true NRMSE: {', '.join(known)}")
    return "; ".join(parts)
