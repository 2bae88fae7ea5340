"""Figures of merit: PSNR (dB), SSIM and NRMSE of a volume against the truth, NRMSE of its views,
errors of estimated cameras, and a method's own error estimates.

PSNR is torchmetrics' (a slow import). SSIM has a Gaussian window of 1.5 voxels and reflected
borders (Wang et al. 2004, IEEE TIP 13(4)), as torchmetrics' non-separable convolution, which takes
14 GB for 64^3 voxels. The data range is an argument, so that figures of different volumes are
comparable.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import data_range_of, divided
from mvrecon.core.parts import METRICS
from mvrecon.methods.method import Alignment, Reconstruction

#: Unit of each figure.
UNITS = {
    "psnr": "dB",
    "ssim": "1",
    "nrmse": "1",
    "psnr_inside": "dB",
    "ssim_inside": "1",
    "nrmse_inside": "1",
    "view_nrmse": "1",
}
#: Standard deviation of SSIM's window and its half width, in voxels.
SIGMA, REACH = 1.5, 5
#: Least data range per greatest true value: the variances of values far beyond the range, which are
#: differences of means of squares, have rounding errors of the size of SSIM's constants.
LEAST = 1e-6


def nrmse(x: Float[Tensor, "*n"], truth: Float[Tensor, "*n"]) -> float:
    """||x - truth|| / ||truth||; for a zero truth 0 if x is zero, else infinite."""
    error, size = torch.linalg.vector_norm(x - truth).item(), torch.linalg.vector_norm(truth).item()
    if size == 0:
        return 0.0 if error == 0 else math.inf
    return error / size


def volume_metrics(
    volume: Float[Tensor, "1 d h w"],
    truth: Float[Tensor, "1 d h w"],
    inside: Bool[Tensor, "1 d h w"],
    data_range: float,
) -> dict[str, float]:
    """Return PSNR in dB (infinite for equal volumes), SSIM and NRMSE of one volume, over the whole
    grid and inside the object, and plugins' figures of merit by name.

    A volume of one slice has the SSIM of an image. SSIM inside is the mean of the SSIM map over the
    object's voxels. For an empty object figures inside are nan.

    Raises:
        TypeError: a data range that is not a number.
        ValueError: shapes that differ, fewer than 6 voxels along an axis, or a data range that is
            not positive and finite, or below a millionth of the truth's greatest value.
    """
    if not volume.shape == truth.shape == inside.shape or volume.ndim != 4:
        shapes = [tuple(x.shape) for x in (volume, truth, inside)]
        raise ValueError(
            f"Metrics need volume, truth and inside of one shape [1 d h w], got {shapes}"
        )
    shape = tuple(volume.shape[1:])
    if min(shape[1:] if shape[0] == 1 else shape) <= REACH:
        raise ValueError(
            f"SSIM's window needs at least {REACH + 1} voxels along each axis, got {shape}"
        )
    data_range = data_range_of(data_range)
    volume, truth = volume.detach().double(), truth.double()
    similarity = ssim_map(volume, truth, data_range)
    brought = {name: METRICS.get(name) for name in METRICS.names()}
    whole = {
        **{name: float(f(volume, truth, inside, data_range)) for name, f in brought.items()},
        "psnr": _psnr(volume, truth, data_range),
        "ssim": similarity.mean().item(),
        "nrmse": nrmse(volume, truth),
    }
    if not inside.any():
        return whole | {"psnr_inside": math.nan, "ssim_inside": math.nan, "nrmse_inside": math.nan}
    return whole | {
        "psnr_inside": _psnr(volume[inside], truth[inside], data_range),
        "ssim_inside": similarity[inside].mean().item(),
        "nrmse_inside": nrmse(volume[inside], truth[inside]),
    }


def ssim_map(
    volume: Float[Tensor, "*n d h w"], truth: Float[Tensor, "*n d h w"], data_range: float
) -> Float[Tensor, "*n d h w"]:
    """Structural similarity around each voxel, without unit (Wang et al. 2004, equation 13); axes
    of one voxel are ignored.

    Raises:
        TypeError: a data range that is not a number.
        ValueError: a data range that is not positive and finite, or below a millionth of the
            truth's greatest value.
    """
    top, data_range = truth.abs().max().item(), data_range_of(data_range)
    if data_range < LEAST * top:
        raise ValueError(
            f"data_range: expected at least {LEAST} of the truth's greatest value, {top:.3g}, got "
            f"{data_range:.3g}; is it in another unit?"
        )
    # relative to the greatest value, so that no square overflows
    scale = max(top, volume.abs().max().item(), data_range)
    volume, truth, relative = volume / scale, truth / scale, data_range / scale
    stable = (0.01 * relative) ** 2, (0.03 * relative) ** 2
    mean, mean_true = _blurred(volume), _blurred(truth)
    variances = (_blurred(volume**2) - mean**2).clamp_min(0)
    variances += (_blurred(truth**2) - mean_true**2).clamp_min(0)
    covariance = _blurred(volume * truth) - mean * mean_true
    pairs = (
        (2 * mean * mean_true + stable[0], mean**2 + mean_true**2 + stable[0]),
        (2 * covariance + stable[1], variances + stable[1]),
    )
    luminance, structure = (divided(both, sum_of_each, 1.0) for both, sum_of_each in pairs)
    return luminance * structure


def _blurred(x: Float[Tensor, "*n d h w"]) -> Float[Tensor, "*n d h w"]:
    """Gaussian means over the window, axis by axis."""
    for axis in (axis for axis in (-3, -2, -1) if x.shape[axis] > 1):
        x = (x.movedim(axis, -1) @ _window(x.shape[axis]).to(x)).movedim(-1, axis)
    return x


def _window(count: int) -> Float[Tensor, "n n"]:
    """Weights of each voxel of an axis (row) for each mean (column), reflected at its ends."""
    steps = torch.arange(-REACH, REACH + 1)
    weights = torch.exp(-0.5 * (steps.double() / SIGMA) ** 2)
    places = (torch.arange(count)[:, None] + steps).abs()
    places = count - 1 - (count - 1 - places).abs()
    window = torch.zeros(count, count, dtype=torch.float64)
    return window.scatter_add_(1, places, (weights / weights.sum()).expand_as(places)).T


def view_metrics(
    views: Float[Tensor, "*n m v u"], measured: Float[Tensor, "*n m v u"]
) -> dict[str, float]:
    """NRMSE of predicted against measured views, over all cameras together.

    Raises:
        ValueError: shapes that differ.
    """
    if views.shape != measured.shape:
        raise ValueError(
            f"Predicted views are {tuple(views.shape)}, but the measured ones "
            f"{tuple(measured.shape)}"
        )
    return {"view_nrmse": nrmse(views.detach().double(), measured.double())}


def case_metrics(
    volume: Float[Tensor, "1 d h w"],
    views: Float[Tensor, "1 m v u"],
    case: Mapping[str, Any],
    data_range: float,
) -> dict[str, float]:
    """Return all figures of merit of one case, `volume_metrics` and `view_metrics`; all nan for a
    failed volume, with NaN or infinity.

    Args:
        volume: reconstructed.
        views: of that volume.
        case: a batch of one, with the true "volume", "inside" and the measured "views".
        data_range: for PSNR and SSIM.

    Raises:
        TypeError, ValueError: as `volume_metrics`.
    """
    data_range = data_range_of(data_range)
    if not volume.isfinite().all():
        return dict.fromkeys((*METRICS.names(), *UNITS), math.nan)
    figures = volume_metrics(volume, case["volume"][0], case["inside"][0], data_range)
    return figures | view_metrics(views, case["views"][0])


def camera_metrics(
    by: Alignment,
    shift_px: Float[Tensor, "b m 2"],
    gain: Float[Tensor, "b m"],
    wrong: Bool[Tensor, "b m"],
) -> dict[str, float]:
    """Root-mean-square errors of estimated shifts (pixels) and gains over all cameras, those of
    zero estimates, and the AUC of detecting faulty cameras.

    Args:
        by: the estimates of b cases.
        shift_px, gain: the truth.
        wrong: the faulty cameras, those with any error.
    """
    return {
        "auc": auc(by.deviation(), wrong),
        "shift_rms_px": _rms(by.shift_px - shift_px),
        "gain_rms": _rms(by.gain - gain),
        "true_shift_rms_px": _rms(shift_px),
        "true_gain_rms": _rms(gain - 1),
    }


def auc(score: Float[Tensor, "*n"], positive: Bool[Tensor, "*n"]) -> float:
    """Area under the ROC curve, without a unit: the share of pairs of a positive and a negative in
    which the positive has the higher score; ties count half. nan without such a pair.
    """
    higher = score[positive][:, None] - score[~positive]
    return ((higher.sign() + 1) / 2).double().mean().item()


def coverage(error: Float[Tensor, "*n"], sigma: Float[Tensor, "*n"], share: float) -> float:
    """Share of errors within the interval about zero that nominally contains `share` of them,
    without a unit; nan for no error.

    The interval is that of a Laplace distribution: errors have many small and a few large values,
    at edges, for which a Gaussian's is too wide at 0.68 and too narrow at 0.95.

    Args:
        error: of each value.
        sigma: its standard deviation, in the same unit.
        share: between 0 and 1; 0.68 means |error| <= 0.806 sigma, 0.95 means 2.118 sigma.
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


def mean_and_rms(volume: Float[Tensor, "*c d h w"]) -> list[float]:
    """Mean and root mean square of a volume, in its unit, by which a table recognises a case."""
    values = volume.double()
    return [values.mean().item(), values.square().mean().sqrt().item()]


def mean_and_spread(values: list[float], failed: bool = False) -> dict[str, Any]:
    """Return mean, sample standard deviation (nan for fewer than two), and the values.

    A nan, from a scene without an object, is ignored. A method that has failed in any scene gets
    nan, so that means over different scenes are never compared.
    """
    numbers = [value for value in values if not (failed or math.isnan(value))]
    mean = sum(numbers) / len(numbers) if numbers else math.nan
    spread = statistics.stdev(numbers) if len(numbers) > 1 and math.isfinite(mean) else math.nan
    return {"mean": mean, "std": spread, "values": values}


def _rms(error: Tensor) -> float:
    return error.double().square().mean().sqrt().item()


def _psnr(x: Tensor, truth: Tensor, data_range: float) -> float:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    error = x - truth
    top = error.abs().max()
    if top == 0:
        return math.inf
    # of errors relative to their greatest: no square overflows, and torchmetrics squares the range
    # in float32
    psnr = peak_signal_noise_ratio(error / top, torch.zeros_like(error), data_range=1.0)
    return float(psnr) + 20 * (math.log10(data_range) - math.log10(top.item()))


#: Percent of the voxels that intervals should cover.
SHARES = (68, 95)
#: Figures without the truth, and their wording in `sentence`.
WITHOUT_TRUTH = {
    "predicted_nrmse": "sigma",
    "per_view_spread": "spread of per-view estimates",
    "cross_view_nrmse": "views predicted by the other cameras",
    "view_nrmse": "view NRMSE",
}


def quality_of(out: Reconstruction, scene: Mapping[str, Any]) -> dict[str, float]:
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
        figures |= {f"coverage_{share}": coverage(*off, share / 100) for share in SHARES}
    if out.per_view is not None and out.weights is not None:
        figures["per_view_spread"] = per_view_spread(out.per_view, out.weights)
    if out.camera_weights is not None and "wrong" in scene:
        figures["wrong_cameras_auc"] = auc(-out.camera_weights, scene["wrong"])
    if out.predictions is not None and out.binned_views is not None:
        figures["cross_view_nrmse"] = nrmse(out.predictions, out.binned_views)
    return figures


def quality_row(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise all figures over the scenes; for those without the truth also "rank", Spearman's
    correlation with the true NRMSE (nan for fewer than three scenes).
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
    """Spearman's rank correlation, without a unit; nan for fewer than three pairs, or
    with a nan.
    """
    from torchmetrics.functional.regression import spearman_corrcoef  # slow to import

    pair = torch.tensor([values, others], dtype=torch.float64)
    if pair.shape[1] < 3 or not pair.isfinite().all():
        return math.nan
    return spearman_corrcoef(pair[0], pair[1]).item()


def sentence(quality: Mapping[str, Any]) -> str:
    """Describe the coverage of the intervals, if any, and the ranks; empty for the view
    NRMSE only.
    """
    if not quality.keys() - {"view_nrmse"}:
        return ""
    parts = []
    if "coverage_68" in quality:
        covered = " and ".join(f"{quality[f'coverage_{share}']['mean']:.1%}" for share in SHARES)
        parts.append(f"intervals of 68 % and 95 % cover {covered} of the voxels inside")
    if "wrong_cameras_auc" in quality:
        area = quality["wrong_cameras_auc"]["mean"]
        parts.append(f"camera weights detect the wrong views with an AUC of {area:.3f}")
    ranks = {WITHOUT_TRUTH[k]: q["rank"] for k, q in quality.items() if "rank" in q}
    known = [f"{name} {rank:.2f}" for name, rank in ranks.items() if not math.isnan(rank)]
    if known:
        parts.append(f"rank correlation with the true NRMSE: {', '.join(known)}")
    return "; ".join(parts)


#: Standard errors from which a camera counts as faulty.
CLEAR = 3.0
#: Weight relative to uniform weights, below which a view may be faulty.
LITTLE = 0.4
#: True shifts and gains of a batch, and the faulty cameras, by their names in it.
TRUTH = ("shift_px", "gain", "wrong")


def cameras_of(alignment: Alignment | None, scene: Mapping[str, Any]) -> dict[str, Any]:
    """A method's estimates of the cameras of one scene, with the truth if known."""
    if alignment is None:
        return {}
    truth = {f"true_{key}": scene[key] for key in TRUTH if key in scene}
    return {"cameras": alignment, **truth}


def camera_row(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Shifts (pixels), gains and their errors of every camera in every scene, and `camera_metrics`
    if the truth is known; empty without estimates.
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
    """Describe each camera of the first scene whose shift or gain exceeds `CLEAR` standard errors,
    the worst first.
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
    """Describe each camera with a small weight, the smallest first."""
    equal = 1 / max(1, len(weights))
    order = sorted(range(len(weights)), key=lambda m: weights[m])
    return [
        f"camera {m}: the network gives it a weight of {weights[m]:.3f} (equal: {equal:.3f}); its "
        f"view may be wrong"
        for m in order
        if weights[m] < LITTLE * equal
    ]
