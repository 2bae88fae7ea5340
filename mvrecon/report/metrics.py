"""Figures of merit: PSNR, SSIM and NRMSE of a volume against the truth, NRMSE of its views, and
those of plugins.

PSNR is torchmetrics' (a slow import). SSIM has a Gaussian window of 1.5 voxels and reflected
borders (Wang et al. 2004, IEEE TIP 13(4)), as torchmetrics' non-separable convolution, which takes
14 GB for 64^3 voxels. The data range is an argument, so that figures of different volumes are
comparable.
"""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.runs import Figure
from mvrecon.core.numbers import data_range_of, divided
from mvrecon.core.parts import METRICS
from mvrecon.data.dataset import Batch
from mvrecon.geometry.grid import Box

F = TypeVar("F", bound=Callable[..., float | Tensor])
#: Standard deviation of SSIM's window and its half width, in voxels.
SSIM_SIGMA, SSIM_HALF_WIDTH = 1.5, 5
#: Least data range per greatest true value: the variances of values far beyond the range, which are
#: differences of means of squares, have rounding errors of the size of SSIM's constants.
MIN_RANGE = 1e-6


@dataclass(frozen=True)
class Metric:
    """Decorator that declares how tables show a figure of merit, an entry of `METRICS`.

    Args:
        unit: unit of the figure, "1" for none; "": not declared.
        column: heading of its column, without the unit; "": its name.
        format: format of its numbers.
        higher_is_better: whether a better volume has a higher figure.
        of_views: whether it is f(views, measured) of the volume's views [1 m v u] and the measured
            ones, instead of f(volume, truth, inside, data_range).

    Examples:
        >>> from mvrecon.report.metrics import Metric
        >>> @Metric(unit="1", column="sum")
        ... def sum_ratio(volume, truth, inside, data_range):
        ...     return volume.sum() / truth.sum()
    """

    unit: str = ""
    column: str = ""
    format: str = ".4g"
    higher_is_better: bool = False
    of_views: bool = False

    def __call__(self, figure: F) -> F:
        setattr(figure, "metric", self)  # noqa: B010 - no such attribute by type
        return figure

    @property
    def heading(self) -> str:
        """The column's heading with the unit, if any."""
        return f"{self.column} {self.unit}" if self.unit not in ("", "1") else self.column


def declared(name: str) -> Metric:
    """How tables show a registered figure of merit.

    Raises:
        LookupError: an unknown name.
        ImportError: a plugin's figure that does not import.
    """
    metric: Metric = getattr(METRICS.get(name), "metric", Metric())
    return replace(metric, column=metric.column or name)


@Metric(unit="dB", column="PSNR", format=".2f", higher_is_better=True)
def psnr(volume: Tensor, truth: Tensor, inside: Tensor, data_range: float) -> float:
    """Peak signal-to-noise ratio over the whole grid; infinite for equal volumes.

    Raises:
        TypeError, ValueError: a data range that is no positive and finite number.
    """
    return _psnr(volume, truth, data_range)


@Metric(unit="dB", column="PSNR inside", format=".2f", higher_is_better=True)
def psnr_inside(volume: Tensor, truth: Tensor, inside: Tensor, data_range: float) -> float:
    """Peak signal-to-noise ratio inside the object; nan for an empty one.

    Raises:
        TypeError, ValueError: as `psnr`.
    """
    return _psnr(volume[inside], truth[inside], data_range) if inside.any() else math.nan


def _psnr(x: Float[Tensor, "*n"], truth: Float[Tensor, "*n"], data_range: float) -> float:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    data_range = data_range_of(data_range)
    error = x - truth
    top = error.abs().max()
    if top == 0:
        return math.inf
    # of errors relative to their greatest: no square overflows, and torchmetrics squares the range
    # in float32
    psnr = peak_signal_noise_ratio(error / top, torch.zeros_like(error), data_range=1.0)
    return float(psnr) + 20 * (math.log10(data_range) - math.log10(top.item()))


@Metric(unit="1", column="SSIM", format=".4f", higher_is_better=True)
def ssim(volume: Tensor, truth: Tensor, inside: Tensor, data_range: float) -> float:
    """Structural similarity, the mean of its map over the whole grid; a volume of one slice has
    that of an image.
    """
    return ssim_map(volume, truth, data_range).mean().item()


@Metric(unit="1", column="SSIM inside", format=".4f", higher_is_better=True)
def ssim_inside(volume: Tensor, truth: Tensor, inside: Tensor, data_range: float) -> float:
    """Structural similarity, the mean of its map over the object's voxels; nan for an empty one."""
    if not inside.any():
        return math.nan
    # the map depends on the window's voxels
    box = (..., *Box.around(inside).grown(SSIM_HALF_WIDTH, inside.shape[-3:]).slices)
    return ssim_map(volume[box], truth[box], data_range)[inside[box]].mean().item()


def ssim_map(
    volume: Float[Tensor, "*n d h w"], truth: Float[Tensor, "*n d h w"], data_range: float
) -> Float[Tensor, "*n d h w"]:
    """Structural similarity around each voxel, without unit (Wang et al. 2004, equation 13), nan
    around values that are not finite; axes of one voxel are ignored.

    Raises:
        TypeError: a data range that is not a number.
        ValueError: a data range that is not positive and finite, or below a millionth of the
            truth's greatest value.
    """
    top, data_range = truth.abs().max().item(), data_range_of(data_range)
    if data_range < MIN_RANGE * top:
        raise ValueError(
            f"data_range: expected at least {MIN_RANGE} of the truth's greatest value, {top:.3g}, "
            f"got {data_range:.3g}; is it in another unit?"
        )
    # relative to the greatest value, so that no square overflows
    scale = max(top, volume.abs().max().item(), data_range)
    volume, truth, relative = volume / scale, truth / scale, data_range / scale
    stable = (0.01 * relative) ** 2, (0.03 * relative) ** 2
    mean, mean_true = _blurred(volume), _blurred(truth)
    known = mean.isfinite() & mean_true.isfinite()
    product, squares = mean * mean_true, mean**2 + mean_true**2
    covariance = _blurred(volume * truth) - product
    variances = (_blurred(volume**2 + truth**2) - squares).clamp_min(0)  # their sum
    structure = divided(2 * covariance + stable[1], variances + stable[1], 1.0)
    similar = structure * divided(2 * product + stable[0], squares + stable[0], 1.0)
    return similar.where(known, math.nan)


def _blurred(x: Float[Tensor, "*n d h w"]) -> Float[Tensor, "*n d h w"]:
    """Gaussian means over the window, axis by axis."""
    for axis in (axis for axis in (-3, -2, -1) if x.shape[axis] > 1):
        x = (x.movedim(axis, -1) @ _window(x.shape[axis]).to(x)).movedim(-1, axis)
    return x


def _window(count: int) -> Float[Tensor, "n n"]:
    """Weights of each voxel of an axis (row) for each mean (column), reflected at its ends."""
    steps = torch.arange(-SSIM_HALF_WIDTH, SSIM_HALF_WIDTH + 1)
    weights = torch.exp(-0.5 * (steps.double() / SSIM_SIGMA) ** 2)
    places = (torch.arange(count)[:, None] + steps).abs()
    places = count - 1 - (count - 1 - places).abs()
    window = torch.zeros(count, count, dtype=torch.float64)
    return window.scatter_add_(1, places, (weights / weights.sum()).expand_as(places)).T


@Metric(unit="1", column="NRMSE", format=".4f")
def nrmse(x: Float[Tensor, "*n"], truth: Float[Tensor, "*n"], *_: Any) -> float:
    """Norm of the error relative to that of the truth, over the whole grid; for a zero truth 0 if x
    is zero, else infinite.

    Args:
        x: reconstructed values.
        truth: true values in the same unit.

    Returns:
        The error, without a unit: 0.1 is an error of 10 %.

    Examples:
        >>> truth = torch.ones(4, 4, 4)
        >>> round(mv.nrmse(1.1 * truth, truth), 6)
        0.1
    """
    top = truth.abs().max().item()
    if top == 0:
        return math.inf if x.any() else 0.0
    scale = math.ldexp(0.5, math.frexp(top)[1])  # no square overflows, and none becomes zero
    error, size = (torch.linalg.vector_norm(one / scale).item() for one in (x - truth, truth))
    return error / size


@Metric(unit="1", column="NRMSE inside", format=".4f")
def nrmse_inside(volume: Tensor, truth: Tensor, inside: Tensor, data_range: float) -> float:
    """Norm of the error relative to that of the truth, inside the object; nan for an empty one."""
    return nrmse(volume[inside], truth[inside]) if inside.any() else math.nan


@Metric(unit="1", column="view NRMSE", format=".4f", of_views=True)
def view_nrmse(views: Float[Tensor, "*n m v u"], measured: Float[Tensor, "*n m v u"]) -> float:
    """Norm of predicted minus measured views relative to that of the measured ones, over all
    cameras together.

    Raises:
        ValueError: shapes that differ.
    """
    if views.shape != measured.shape:
        raise ValueError(
            f"Predicted views are {tuple(views.shape)}, but the measured ones "
            f"{tuple(measured.shape)}"
        )
    return nrmse(views, measured)


def volume_metrics(
    volume: Float[Tensor, "1 d h w"],
    truth: Float[Tensor, "1 d h w"],
    inside: Bool[Tensor, "1 d h w"],
    data_range: float,
) -> dict[str, float]:
    """Return all registered figures of merit of one volume by name: PSNR in dB, SSIM and NRMSE,
    over the whole grid and inside the object, and those of plugins.

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
    if min(shape[1:] if shape[0] == 1 else shape) <= SSIM_HALF_WIDTH:
        raise ValueError(
            f"SSIM's window needs at least {SSIM_HALF_WIDTH + 1} voxels along each axis, got "
            f"{shape}"
        )
    data_range = data_range_of(data_range)
    return _figures(False, volume.detach().double(), truth.double(), inside, data_range)


def _figures(of_views: bool, *arguments: Any) -> dict[str, float]:
    names = [name for name in METRICS.names() if declared(name).of_views == of_views]
    return {name: float(METRICS.get(name)(*arguments)) for name in names}


def case_metrics(
    volume: Float[Tensor, "1 d h w"],
    views: Float[Tensor, "1 m v u"],
    case: Batch,
    data_range: float,
) -> dict[str, float]:
    """Return all registered figures of merit of one case, of its volume and of its views; all nan
    for a failed volume, with NaN or infinity.

    Args:
        volume: reconstructed volume.
        views: projections of that volume.
        case: a batch of one, with the true "volume", "inside" and the measured "views".
        data_range: range of the true values, for PSNR and SSIM.

    Raises:
        TypeError, ValueError: as `volume_metrics`.
    """
    data_range = data_range_of(data_range)
    if not volume.isfinite().all():
        return dict.fromkeys(METRICS.names(), math.nan)
    figures = volume_metrics(volume, case["volume"][0], case["inside"][0], data_range)
    return figures | _figures(True, views.detach().double(), case["views"][0].double())


def auc(score: Float[Tensor, "*n"], positive: Bool[Tensor, "*n"]) -> float:
    """Area under the ROC curve, without a unit: the share of pairs of a positive and a negative in
    which the positive has the higher score; ties count half. nan without such a pair.
    """
    higher = score[positive][:, None] - score[~positive]
    return ((higher.sign() + 1) / 2).double().mean().item()


def mean_and_rms(volume: Float[Tensor, "*c d h w"]) -> list[float]:
    """Mean and root mean square of a volume, in its unit, by which a table recognises a case."""
    values = volume.double()
    return [values.mean().item(), values.square().mean().sqrt().item()]


def mean_and_spread(values: list[float], failed: bool = False) -> Figure:
    """Return mean, sample standard deviation (nan for fewer than two), and the values.

    A nan, from a scene without an object, is ignored. A method that has failed in any scene gets
    nan, so that means over different scenes are never compared.
    """
    numbers = [value for value in values if not (failed or math.isnan(value))]
    mean = sum(numbers) / len(numbers) if numbers else math.nan
    spread = statistics.stdev(numbers) if len(numbers) > 1 and math.isfinite(mean) else math.nan
    return {"mean": mean, "std": spread, "values": values}
