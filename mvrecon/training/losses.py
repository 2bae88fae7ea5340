"""Terms of the training loss, f(out, batch, data_range), and their weighted sum.

Terms have no unit: they are relative to the volumes' value range, so that weights do not depend on
the unit. The default weights of a run are in `conf/train.yaml`.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d

from mvrecon.core.numbers import data_range_of
from mvrecon.core.parts import LOSSES
from mvrecon.core.registry import check_options
from mvrecon.data.dataset import Batch
from mvrecon.methods.method import Reconstruction

Term = Float[Tensor, ""]
#: Share of the truth's power added to the error of the initial volume, the reference of per-view
#: gains.
ADDED_ERROR_SHARE = 1e-6
#: Least variance of a voxel, relative to the square of the value range.
MIN_VARIANCE = 1e-12


def mean_where(values: Float[Tensor, "*n"], where: Bool[Tensor, "*n"] | None) -> Float[Tensor, ""]:
    """Mean of the values where the mask is true; zero for an empty mask."""
    if where is None:
        return values.mean()
    where = where.expand_as(values)
    return (values * where).sum() / where.sum().clamp_min(1)


def at_cells(volume: Float[Tensor, "b c d h w"], like: Tensor) -> Float[Tensor, "b c e i x"]:
    """Means of a volume in the cells of a coarser one, in the volume's unit."""
    edges = [-(-n // k) for n, k in zip(volume.shape[-3:], like.shape[-3:], strict=True)]
    return volume if max(edges) == 1 else avg_pool3d(volume, edges, ceil_mode=True)


def volume(out: Reconstruction, batch: Batch, data_range: float) -> Term:
    """Mean squared error of the volume, without a unit."""
    return mean_where(_error(out, batch, data_range).square(), out.support)


def common_field(out: Reconstruction, batch: Batch, data_range: float) -> Term:
    """Mean squared error of the voxels that all cameras see, without a unit."""
    field = batch["common_field"].to(out.volume.device)
    within = field if out.support is None else out.support & field
    return mean_where(_error(out, batch, data_range).square(), within)


def per_view_gain(out: Reconstruction, batch: Batch, data_range: float) -> Term | None:
    """Logarithm of 1 + the squared error of each per-view estimate relative to that of the initial
    volume where its camera sees, averaged over the cameras, plus the same of the weighted estimate,
    without a unit.

    Both are log 2 if every estimate is the initial volume. The logarithm bounds the influence of
    disturbed views, whose estimates must contain what disturbs them: beside a good initial volume
    such errors are several times its own. None without per-view estimates.
    """
    if out.per_view is None or out.visible is None:
        return None
    estimates, support, visible = out.per_view / data_range, out.support, out.visible
    truth = batch["volume"] / data_range
    if support is not None:
        support = at_cells(support.to(truth.dtype), estimates) > 0
        visible = visible & support[:, None]
    truth = at_cells(truth, estimates)
    start = 0 * truth if out.start is None else at_cells(out.start / data_range, truth)
    before = (start - truth).square()[:, None]
    least = ADDED_ERROR_SHARE * truth.square()[:, None] + torch.finfo(truth.dtype).tiny

    def relative(error: Tensor, where: Tensor) -> Term:
        axes = tuple(range(2, 6))
        whole = ((before + least) * where).sum(dim=axes)
        gain = (error * where).sum(dim=axes) / whole.clamp_min(torch.finfo(whole.dtype).tiny)
        return gain.log1p().mean()

    gain = relative((estimates - truth[:, None]).square(), visible)
    if out.weights is None:
        return gain
    anywhere = visible.any(dim=-5, keepdim=True)
    fused = (out.weights * out.per_view).sum(dim=1, keepdim=True) / data_range
    return gain + relative((fused - truth[:, None]).square(), anywhere)


def cross_view(out: Reconstruction, batch: Batch, data_range: float) -> Term | None:
    """Squared error of each view as predicted by the other cameras' estimates, relative to the
    views, without a unit. None without predictions.
    """
    if out.predictions is None:
        return None
    views = out.binned_views
    assert views is not None
    power = views.square().flatten(1).mean(dim=1)  # of each case: a bright one hides none
    error = (out.predictions - views).square().flatten(1).mean(dim=1)
    return (error / power.clamp_min(torch.finfo(power.dtype).tiny)).mean()


def entry(out: Reconstruction, batch: Batch, data_range: float) -> Term | None:
    """Mean squared error of the input of expectation maximisation, which hides its scale and
    negative values, without a unit.

    Without this term networks may drift there. Its weight is small, as the input need not be the
    best volume. None without that input.
    """
    if out.entry is None:
        return None
    error = out.entry / data_range - batch["volume"] / data_range
    return mean_where(error.square(), out.support)


def uncertainty(out: Reconstruction, batch: Batch, data_range: float) -> Term | None:
    """Mean Gaussian negative log-likelihood of the volume's error under the method's estimated
    standard deviations, without a unit (Nix & Weigend, IEEE ICNN 1994).

    No gradient reaches the volume. None without standard deviations.
    """
    if out.sigma is None:
        return None
    variance = (out.sigma / data_range).square()
    if out.support is not None:  # outside, volume and error are zero by definition
        variance = torch.where(out.support, variance, 1.0)
    # torch's own loss synchronises to check for negative variances; as there, clamping keeps the
    # gradient
    variance = variance + (variance.clamp_min(MIN_VARIANCE) - variance).detach()
    error = _error(out, batch, data_range).detach()
    return mean_where((variance.log() + error.square() / variance) / 2, out.support)


def _error(out: Reconstruction, batch: Batch, data_range: float) -> Tensor:
    return out.volume / data_range - batch["volume"] / data_range


#: Data ranges for which squared errors in float32 neither overflow nor vanish.
DATA_RANGE_LIMITS = (1e-15, 1e15)


class ReconstructionLoss(nn.Module):
    """Weighted sum of the registered terms.

    If a method has a support, volume errors are averaged over its voxels: all others are 0 by
    definition, without gradient. The figures of merit cover the whole grid.

    Args:
        data_range: value range of the volumes, in their unit.
        weights: weight of each term, by name; 0 disables one. That of the volume is 1 if not given.

    Raises:
        TypeError: an unknown term, or a data range that is not a number.
        ValueError: a data range that is not positive and finite, or beyond `DATA_RANGE_LIMITS`.
    """

    def __init__(self, data_range: float, **weights: float):
        super().__init__()
        self.data_range, self.weights = data_range_of(data_range), {"volume": 1.0, **weights}
        if not DATA_RANGE_LIMITS[0] <= self.data_range <= DATA_RANGE_LIMITS[1]:
            raise ValueError(
                f"data_range: expected {DATA_RANGE_LIMITS[0]:g} to {DATA_RANGE_LIMITS[1]:g}, whose "
                f"squares float32 holds, got {data_range}"
            )
        check_options("The loss", weights, LOSSES.names())
        if infinite := [name for name, w in weights.items() if not math.isfinite(w)]:
            raise ValueError(
                f"loss.{infinite[0]}: expected a finite weight, got {weights[infinite[0]]}"
            )
        self.terms = {name: LOSSES.get(name) for name, weight in self.weights.items() if weight}

    def forward(self, out: Reconstruction, batch: Batch) -> dict[str, Term]:
        """Return each unweighted term that the reconstruction has, and the weighted sum as "total".

        Args:
            out: the method's reconstruction.
            batch: "volume"; if weighted, "common_field" [1 d h w], the voxels that all cameras
                see; and all that plugins' terms read.

        Raises:
            ValueError: no term of a non-zero weight applies to the reconstruction.
        """
        computed = {name: term(out, batch, self.data_range) for name, term in self.terms.items()}
        terms = {k: value for k, value in computed.items() if value is not None}
        if not terms:
            raise ValueError(
                f"Expected a term of the loss that the method's reconstruction has, got "
                f"{self.weights}; give loss.volume a weight"
            )
        total = sum(self.weights[name] * value for name, value in terms.items())
        return {**terms, "total": torch.as_tensor(total)}
