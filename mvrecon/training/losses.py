"""Training losses, relative to the volumes' value range, so that weights do not depend on the unit.

The default weights of a run are in `conf/train.yaml`.
"""

from dataclasses import asdict, dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d

from mvrecon.core.numbers import data_range_of
from mvrecon.core.parts import LOSSES
from mvrecon.core.registry import check_options
from mvrecon.methods.method import Reconstruction

#: Share of the truth's power added to the error of the initial volume, the reference of per-view
#: gains.
LEAST = 1e-6
#: Least variance of a voxel, relative to the square of the value range.
VARIANCE = 1e-12


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


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of a training loss; 0 disables a term.

    Args:
        volume: of the mean squared error.
        common_field: of the mean squared error of the voxels that all cameras see.
        per_view_gain: of the squared error of each per-view estimate relative to that of the
            initial volume where its camera sees, averaged over the cameras, plus the same of the
            weighted estimate; both are 1 if every estimate is the initial volume.
        cross_view: of the squared error of each view as predicted by the other cameras' estimates,
            relative to the views.
        entry: of the mean squared error of the input of expectation maximisation, which hides its
            scale and negative values: without this term networks may drift there. Small, as the
            input need not be the best volume.
        uncertainty: of the mean Gaussian negative log-likelihood of the volume's error under the
            method's estimated standard deviations (Nix & Weigend, IEEE ICNN 1994); absent without
            these, and without gradient in the volume.
    """

    volume: float = 1.0
    common_field: float = 0.0
    per_view_gain: float = 0.0
    cross_view: float = 0.0
    entry: float = 0.0
    uncertainty: float = 0.0


#: Names of mvrecon's own terms.
TERMS = tuple(field.name for field in fields(Weights))


#: Data ranges for which squared errors in float32 neither overflow nor vanish.
RANGES = (1e-15, 1e15)


class ReconstructionLoss(nn.Module):
    """Weighted sum of the errors of the volume, of the per-view estimates, and of their predictions
    of the other cameras' views.

    If a method has a support, volume errors are averaged over its voxels: all others are 0 by
    definition, without gradient. The figures of merit cover the whole grid.

    Args:
        data_range: value range of the volumes, in their unit.
        weights: of `Weights`, and of plugins' terms, by name.

    Raises:
        TypeError: an unknown term, or a data range that is not a number.
        ValueError: a data range that is not positive and finite, or beyond `RANGES`.
    """

    def __init__(self, data_range: float, **weights: float):
        super().__init__()
        self.data_range = data_range_of(data_range)
        if not RANGES[0] <= self.data_range <= RANGES[1]:
            raise ValueError(
                f"data_range: expected {RANGES[0]:g} to {RANGES[1]:g}, whose squares float32 "
                f"holds, got {data_range}"
            )
        check_options("The loss", weights, [*TERMS, *LOSSES.names()])
        brought = {name: weight for name, weight in weights.items() if name not in TERMS}
        self.brought = {name: LOSSES.get(name) for name, weight in brought.items() if weight}
        own = {name: weight for name, weight in weights.items() if name in TERMS}
        self.weights = asdict(Weights(**own)) | brought

    def forward(
        self, out: Reconstruction, batch: dict[str, Tensor]
    ) -> dict[str, Float[Tensor, ""]]:
        """Return each unweighted term, and the weighted sum as "total".

        Args:
            out: of the method.
            batch: "volume"; if weighted, "common_field" [1 d h w], the voxels that all cameras
                see; and all that plugins' terms read.
        """
        truth = batch["volume"] / self.data_range
        volume = out.volume / self.data_range
        error = (volume - truth).square()
        terms = {"volume": mean_where(error, out.support)}
        if self.weights["common_field"]:
            field = batch["common_field"].to(error.device)
            within = field if out.support is None else out.support & field
            terms["common_field"] = mean_where(error, within)
        terms |= self._of_cameras(out, truth)
        if out.entry is not None and self.weights["entry"]:
            entry = out.entry / self.data_range
            terms["entry"] = mean_where((entry - truth).square(), out.support)
        if out.sigma is not None and self.weights["uncertainty"]:
            terms["uncertainty"] = self._uncertainty(out, volume, truth)
        terms |= {name: term(out, batch, self.data_range) for name, term in self.brought.items()}
        total = sum(self.weights[name] * value for name, value in terms.items())
        return {**terms, "total": torch.as_tensor(total)}

    def _uncertainty(self, out: Reconstruction, volume: Tensor, truth: Tensor) -> Float[Tensor, ""]:
        assert out.sigma is not None
        variance = (out.sigma / self.data_range).square()
        if out.support is not None:  # outside, volume and error are zero by definition
            variance = torch.where(out.support, variance, 1.0)
        # torch's own loss synchronises to check for negative variances; as there, clamping keeps
        # the gradient
        variance = variance + (variance.clamp_min(VARIANCE) - variance).detach()
        error = volume.detach() - truth
        return mean_where((variance.log() + error.square() / variance) / 2, out.support)

    def _of_cameras(self, out: Reconstruction, truth: Tensor) -> dict[str, Float[Tensor, ""]]:
        """The terms of the per-view estimates, at their resolution."""
        terms = {}
        if out.per_view is not None and out.visible is not None:
            estimates, support = out.per_view / self.data_range, out.support
            if support is not None:
                support = at_cells(support.to(truth.dtype), estimates) > 0
            truth = at_cells(truth, estimates)
            error = (estimates - truth[:, None]).square()
            if self.weights["per_view_gain"]:
                terms["per_view_gain"] = self._gain(out, error, truth, support)
        if self.weights["cross_view"] and out.predictions is not None:
            views = out.binned_views
            assert views is not None
            power = views.square().flatten(1).mean(dim=1)  # of each case: a bright one hides none
            error = (out.predictions - views).square().flatten(1).mean(dim=1)
            terms["cross_view"] = (error / power.clamp_min(torch.finfo(power.dtype).tiny)).mean()
        return terms

    def _gain(
        self, out: Reconstruction, error: Tensor, truth: Tensor, support: Tensor | None
    ) -> Float[Tensor, ""]:
        assert out.per_view is not None and out.visible is not None
        visible = out.visible if support is None else out.visible & support[:, None]
        start = 0 * truth if out.start is None else at_cells(out.start / self.data_range, truth)
        before = (start - truth).square()[:, None]
        least = LEAST * truth.square()[:, None] + torch.finfo(truth.dtype).tiny

        def relative(error: Tensor, where: Tensor) -> Float[Tensor, ""]:
            axes = tuple(range(2, 6))
            whole = ((before + least) * where).sum(dim=axes)
            gain = (error * where).sum(dim=axes) / whole.clamp_min(torch.finfo(whole.dtype).tiny)
            return gain.mean()

        gain = relative(error, visible)
        if out.weights is None:
            return gain
        anywhere = visible.any(dim=-5, keepdim=True)
        fused = (out.weights * out.per_view).sum(dim=1, keepdim=True) / self.data_range
        return gain + relative((fused - truth[:, None]).square(), anywhere)
