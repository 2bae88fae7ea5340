"""Figures of merit: PSNR (dB), SSIM and NRMSE of a volume against the truth, NRMSE of its views,
and how well wrong cameras are told.

PSNR is torchmetrics' (imported late: it is slow). SSIM has a Gaussian window of 1.5 voxels and
reflected borders (Wang et al. 2004, IEEE TIP 13(4)), as torchmetrics' has, whose convolution with
the whole window takes 14 GB for 64^3 voxels. The data range is an argument, never taken from the
data, so that numbers of different volumes compare.
"""

import math
import statistics
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.parts import METRICS
from mvrecon.methods.reconstruction import Alignment

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


def nrmse(x: Float[Tensor, "*n"], truth: Float[Tensor, "*n"]) -> float:
    """||x - truth|| / ||truth||; for a truth of zeros, 0 where x is zero too and infinite where it
    is not.
    """
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
    """PSNR in dB (infinite for equal volumes), SSIM and NRMSE of one volume, over all of it and
    inside the object; and the figures of merit of plugins, by their names.

    A volume of one slice has the SSIM of an image. SSIM inside is the mean of the SSIM map over the
    object's voxels. Without any voxel inside, those figures are nan.

    Raises:
        ValueError: shapes that differ, fewer than 6 voxels along an axis, or a data range that is
            not positive.
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
    if not data_range > 0:
        raise ValueError(f"data_range must be positive, got {data_range}")
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
    """Structural similarity of each voxel's surroundings, without unit (Wang et al. 2004, equation
    13); axes of one voxel have none.
    """
    stable = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    mean, mean_true = _blurred(volume), _blurred(truth)
    variances = (_blurred(volume**2) - mean**2).clamp_min(0)
    variances += (_blurred(truth**2) - mean_true**2).clamp_min(0)
    covariance = _blurred(volume * truth) - mean * mean_true
    luminance = (2 * mean * mean_true + stable[0]) / (mean**2 + mean_true**2 + stable[0])
    return luminance * (2 * covariance + stable[1]) / (variances + stable[1])


def _blurred(x: Float[Tensor, "*n d h w"]) -> Float[Tensor, "*n d h w"]:
    """Gaussian means over the window, axis by axis."""
    for axis in (axis for axis in (-3, -2, -1) if x.shape[axis] > 1):
        x = (x.movedim(axis, -1) @ _window(x.shape[axis]).to(x)).movedim(-1, axis)
    return x


def _window(count: int) -> Float[Tensor, "n n"]:
    """The weights of each voxel of an axis (row) for each mean (column), reflected at its ends."""
    steps = torch.arange(-REACH, REACH + 1)
    weights = torch.exp(-0.5 * (steps.double() / SIGMA) ** 2)
    places = (torch.arange(count)[:, None] + steps).abs()
    places = count - 1 - (count - 1 - places).abs()
    window = torch.zeros(count, count, dtype=torch.float64)
    return window.scatter_add_(1, places, (weights / weights.sum()).expand_as(places)).T


def view_metrics(
    views: Float[Tensor, "*n m v u"], measured: Float[Tensor, "*n m v u"]
) -> dict[str, float]:
    """NRMSE of predicted views against measured ones, over all cameras together.

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
    """Every figure of merit of one case: `volume_metrics` and `view_metrics`; all are nan where the
    volume has failed, that is, holds NaN or infinity.

    Args:
        volume: reconstructed.
        views: of that volume.
        case: a batch of one, with the true "volume", "inside" and the measured "views".
        data_range: for PSNR and SSIM.
    """
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
    """Root-mean-square errors of estimated shifts (pixels) and gains over all cameras, beside those
    of estimating nothing, and the AUC of telling which cameras are wrong.

    Args:
        by: the estimates of b cases.
        shift_px, gain: the truth.
        wrong: the cameras with any error, these or others.
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
    """Share of errors within the Gaussian interval about zero that should hold `share` of them,
    without a unit; nan for no error.

    Args:
        error: of each value.
        sigma: its standard deviation, in the same unit.
        share: between 0 and 1; 0.68 means |error| <= 0.994 sigma, 0.95 means 1.96 sigma.
    """
    wide = statistics.NormalDist().inv_cdf((1 + share) / 2)
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


def mean_and_spread(values: list[float], failed: bool = False) -> dict[str, Any]:
    """Mean, sample standard deviation (nan where there is none), and the values.

    A nan among them, from a scene without an object, counts in neither. A method that has failed
    in a scene has neither, so that no mean over the other scenes can pass for its own.
    """
    numbers = [value for value in values if not (failed or math.isnan(value))]
    mean = sum(numbers) / len(numbers) if numbers else math.nan
    spread = statistics.stdev(numbers) if len(numbers) > 1 and math.isfinite(mean) else math.nan
    return {"mean": mean, "std": spread, "values": values}


def _rms(error: Tensor) -> float:
    return error.double().square().mean().sqrt().item()


def _psnr(x: Tensor, truth: Tensor, data_range: float) -> float:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    return float(peak_signal_noise_ratio(x, truth, data_range=data_range))
