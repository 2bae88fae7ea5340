"""What a method reports of its own error and of the cameras, without the truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mvrecon.methods.reconstruction import Alignment, Reconstruction
from mvrecon.report.metrics import (
    auc,
    camera_metrics,
    coverage,
    mean_and_spread,
    nrmse,
    per_view_spread,
)

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


def binned_like(
    views: Float[Tensor, "b 1 m v u"], like: Float[Tensor, "b k m r s"]
) -> Float[Tensor, "b 1 m r s"]:
    """Means of views over the cells of pixels that other views have, in the views' unit."""
    edge = -(-views.shape[-1] // like.shape[-1])
    pooled = avg_pool2d(views.flatten(0, 2), edge, ceil_mode=True)
    return pooled.unflatten(0, views.shape[:3])


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


#: Standard errors from which a camera counts as wrong.
CLEAR = 3.0
#: Of the weight that each camera would have if all had the same: below, its view may be wrong.
LITTLE = 0.4
#: The true shifts and gains of a batch, and which cameras are wrong, by their names in it.
TRUTH = ("shift_px", "gain", "wrong")


def cameras_of(alignment: Alignment | None, scene: Mapping[str, Any]) -> dict[str, Any]:
    """What a method tells of the cameras of one scene, beside the truth where it is known."""
    if alignment is None:
        return {}
    truth = {f"true_{key}": scene[key] for key in TRUTH if key in scene}
    return {"cameras": alignment, **truth}


def camera_row(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Shifts (pixels), gains and their errors of every camera in every scene, and the figures of
    `camera_metrics` where the truth is known; empty where a method tells nothing.
    """
    known = [score for score in scores if "cameras" in score]
    if not known:
        return {}
    by = Alignment.joined([score["cameras"] for score in known])
    row = {"deviation": by.deviation().tolist()}
    row |= {field.name: getattr(by, field.name).tolist() for field in fields(Alignment)}
    if all("true_gain" in score for score in known):
        truth = (torch.cat([score[f"true_{key}"] for score in known]) for key in TRUTH)
        row |= camera_metrics(by, *truth)
    return {"cameras": row}


def disturbed_cameras(row: Mapping[str, Any] | None) -> list[str]:
    """One line for each camera of the first scene whose shift or gain is more than `CLEAR` of its
    standard errors from none, the worst first.
    """
    if row is None:
        return []
    names = [field.name for field in fields(Alignment)]
    by = Alignment(*(torch.tensor(row[name])[:1] for name in names))
    shift = by.shift_px.abs() > CLEAR * by.shift_error
    clear = (shift.any(dim=-1) | ((by.gain - 1).abs() > CLEAR * by.gain_error))[0]
    order = by.deviation()[0].argsort(descending=True)
    lines = []
    for m in (int(m) for m in order if clear[m]):
        if by.gain[0, m] == 0:
            lines.append(f"camera {m}: its view is lost")
            continue
        (u, v), (u_error, v_error) = by.shift_px[0, m].tolist(), by.shift_error[0, m].tolist()
        lines.append(
            f"camera {m}: shifted by {u:+.2f} +- {u_error:.2f} columns and {v:+.2f} +- "
            f"{v_error:.2f} rows, gain {by.gain[0, m]:.3f} +- {by.gain_error[0, m]:.3f}"
        )
    return lines


def little_weight(weights: Sequence[float]) -> list[str]:
    """One line for each camera to which a network gives little weight, the least first."""
    equal = 1 / max(1, len(weights))
    order = sorted(range(len(weights)), key=lambda m: weights[m])
    return [
        f"camera {m}: the network gives it a weight of {weights[m]:.3f} (equal: {equal:.3f}); its "
        f"view may be wrong"
        for m in order
        if weights[m] < LITTLE * equal
    ]
