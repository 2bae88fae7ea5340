"""Training losses, relative to the volumes' value range, so that the same weights serve every unit.

The weights of a training run are those of `conf/train.yaml`.
"""

from dataclasses import asdict, dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, avg_pool3d

from mvrecon.models.output import Reconstruction
from mvrecon.parts import LOSSES
from mvrecon.registry import check_options

#: Weight of a round's volume relative to that of the round behind it.
EARLIER = 0.4
#: Of the truth's power: as much counts each start's error where opinions are compared with it.
LEAST = 1e-6
#: The least variance that a voxel may have, relative to the square of the value range.
VARIANCE = 1e-12


def edge_difference(
    a: Float[Tensor, "b 1 d h w"],
    b: Float[Tensor, "b 1 d h w"],
    support: Bool[Tensor, "b 1 d h w"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared difference of the first differences along the three axes: edges count, offsets
    do not.

    With a support only differences between two of its voxels count.
    """
    error, terms = a - b, []
    for axis in (2, 3, 4):
        pairs = None if support is None else _neighbours(support, axis)
        terms.append(mean_where(error.diff(dim=axis).square(), pairs))
    return torch.stack(terms).mean()


def mean_where(values: Float[Tensor, "*n"], where: Bool[Tensor, "*n"] | None) -> Float[Tensor, ""]:
    """Mean of the values where the mask is true; zero if it is true nowhere."""
    if where is None:
        return values.mean()
    where = where.expand_as(values)
    return (values * where).sum() / where.sum().clamp_min(1)


def _neighbours(support: Bool[Tensor, "b 1 d h w"], axis: int) -> Tensor:
    count = support.shape[axis] - 1
    return support.narrow(axis, 0, count) & support.narrow(axis, 1, count)


def at_cells(volume: Float[Tensor, "b c d h w"], like: Tensor) -> Float[Tensor, "b c e i x"]:
    """Means of a volume in the cells of a coarser one, in the volume's unit."""
    edges = [-(-n // k) for n, k in zip(volume.shape[-3:], like.shape[-3:], strict=True)]
    return volume if max(edges) == 1 else avg_pool3d(volume, edges, ceil_mode=True)


def binned_like(
    views: Float[Tensor, "b 1 m v u"], like: Float[Tensor, "b k m r s"]
) -> Float[Tensor, "b 1 m r s"]:
    """Means of views over the cells of pixels that other views have, in the views' unit."""
    edge = -(-views.shape[-1] // like.shape[-1])
    pooled = avg_pool2d(views.flatten(0, 2), edge, ceil_mode=True)
    return pooled.unflatten(0, views.shape[:3])


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of a training loss; 0 leaves a term out.

    Args:
        volume: of the mean squared error.
        common_field: of the mean squared error of the voxels that all cameras see, where more is
            seen than what a rig is built for.
        edges: of the squared error of first differences.
        opinions: of the mean squared error of the opinions, where the cameras see.
        opinions_gain: of the squared error of each camera's opinion relative to that of the start
            where this camera sees, the mean over the cameras, and the same of the weighted opinion;
            both are 1 where every opinion is the start.
        cross_view: of the squared error of opinions projected to the other cameras, relative to
            the views.
        rounds: of the mean squared errors of the volumes after earlier rounds, each less than the
            one behind it by the factor `EARLIER`.
        entry: of the mean squared error of the volume that enters expectation maximisation. What
            that hides, a scale and what is negative, has no other error: networks drift there until
            all is zero. Small, since what enters need not be the best volume.
        corrected_views: of the mean squared error of the views as the cameras' networks have
            corrected them, or of the completed sinogram, against the truth's own views A x_true,
            as mean densities along rays.
        uncertainty: of the mean negative log-likelihood of the volume's error under the standard
            deviations that the model expects, Gaussian (Nix & Weigend, IEEE ICNN 1994); it is no
            term where the model expects none, and has no gradient in the volume.
    """

    volume: float = 1.0
    common_field: float = 0.0
    edges: float = 0.0
    opinions: float = 0.0
    opinions_gain: float = 0.0
    cross_view: float = 0.0
    rounds: float = 0.0
    entry: float = 0.0
    corrected_views: float = 0.0
    uncertainty: float = 0.0


#: Names of the terms that are mvrecon's own.
TERMS = tuple(field.name for field in fields(Weights))


class ReconstructionLoss(nn.Module):
    """Weighted sum of the errors of the volume, of each camera's own volume (its opinion), and of
    the views that opinions predict for the other cameras.

    Where a model works on a support, the means of the volumes' errors are over its voxels: all
    others are 0 by definition, and have no gradient. The figures of merit cover the whole grid.

    Args:
        data_range: value range of the volumes, in their unit.
        weights: of `Weights`, and of the terms that plugins bring, by their names.

    Raises:
        TypeError: a term that is not known.
    """

    def __init__(self, data_range: float, **weights: float):
        super().__init__()
        if not data_range > 0:
            raise ValueError(f"data_range must be positive, got {data_range}")
        self.data_range = data_range
        check_options("The loss", weights, [*TERMS, *LOSSES.names()])
        brought = {name: weight for name, weight in weights.items() if name not in TERMS}
        self.brought = {name: LOSSES.get(name) for name, weight in brought.items() if weight}
        own = {name: weight for name, weight in weights.items() if name in TERMS}
        self.weights = asdict(Weights(**own)) | brought

    def forward(
        self, out: Reconstruction, batch: dict[str, Tensor]
    ) -> dict[str, Float[Tensor, ""]]:
        """Each term unweighted, and their weighted sum as "total".

        Args:
            out: of the model.
            batch: "volume" and "views"; where `compares_views` is true of the reconstruction
                "true_views", the truth's own views of the same cameras; and where it has a weight
                "common_field" [1 d h w], the voxels that all cameras see.
        """
        truth, views = batch["volume"] / self.data_range, batch["views"]
        volume = out.volume / self.data_range
        error = (volume - truth).square()
        terms = {"volume": mean_where(error, out.support)}
        if self.weights["common_field"]:
            field = batch["common_field"].to(error.device)
            within = field if out.support is None else out.support & field
            terms["common_field"] = mean_where(error, within)
        if self.weights["edges"]:
            terms["edges"] = edge_difference(volume, truth, out.support)
        terms |= self._of_cameras(out, truth, views)
        if out.earlier and self.weights["rounds"]:
            terms["rounds"] = self._rounds(out, truth)
        if out.entry is not None and self.weights["entry"]:
            entry = out.entry / self.data_range
            terms["entry"] = mean_where((entry - truth).square(), out.support)
        if self.compares_views(out):
            terms["corrected_views"] = self._corrected(out, batch["true_views"])
        if out.sigma is not None and self.weights["uncertainty"]:
            terms["uncertainty"] = self._uncertainty(out, volume, truth)
        terms |= {name: term(out, batch, self.data_range) for name, term in self.brought.items()}
        total = sum(self.weights[name] * value for name, value in terms.items())
        return {**terms, "total": torch.as_tensor(total)}

    def compares_views(self, out: Reconstruction) -> bool:
        """Whether corrected views of this reconstruction are compared with the truth's own."""
        return bool(out.corrected_views and self.weights["corrected_views"])

    def _uncertainty(self, out: Reconstruction, volume: Tensor, truth: Tensor) -> Float[Tensor, ""]:
        assert out.sigma is not None
        variance = (out.sigma / self.data_range).square()
        if out.support is not None:  # outside it all is zero by definition, the error's size too
            variance = torch.where(out.support, variance, 1.0)
        # not torch's own loss, which asks whether a variance is negative, and waits for the answer;
        # as there, the least variance has the gradient of the one that it stands for
        variance = variance + (variance.clamp_min(VARIANCE) - variance).detach()
        error = volume.detach() - truth
        return mean_where((variance.log() + error.square() / variance) / 2, out.support)

    def _rounds(self, out: Reconstruction, truth: Tensor) -> Float[Tensor, ""]:
        errors = [
            EARLIER**behind * mean_where((volume / self.data_range - truth).square(), out.support)
            for behind, volume in enumerate(reversed(out.earlier), start=1)
        ]
        return torch.stack(errors).sum()

    def _corrected(
        self, out: Reconstruction, true_views: Float[Tensor, "b 1 n v u"]
    ) -> Float[Tensor, ""]:
        assert out.row is not None
        weight = out.row / self.data_range
        errors = [(weight * (views - true_views)).square().mean() for views in out.corrected_views]
        return torch.stack(errors).mean()

    def _of_cameras(
        self, out: Reconstruction, truth: Tensor, views: Float[Tensor, "b 1 m v u"]
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms of the opinions, at their resolution."""
        terms = {}
        if out.opinions is not None and out.visible is not None:
            opinions, support = out.opinions / self.data_range, out.support
            if support is not None:
                support = at_cells(support.to(truth.dtype), opinions) > 0
            truth = at_cells(truth, opinions)
            error = (opinions - truth[:, None]).square()
            if self.weights["opinions"]:
                terms["opinions"] = self._opinions(error, out.visible, support)
            if self.weights["opinions_gain"]:
                terms["opinions_gain"] = self._gain(out, error, truth, support)
        if out.cross_views is not None and self.weights["cross_view"]:
            views = binned_like(views, out.cross_views)
            power = views.square().mean().clamp_min(torch.finfo(views.dtype).tiny)
            terms["cross_view"] = (out.cross_views - views).square().mean() / power
        return terms

    @staticmethod
    def _opinions(error: Tensor, visible: Tensor, support: Tensor | None) -> Float[Tensor, ""]:
        if support is None:
            return (error * visible).mean() / visible.float().mean()
        return mean_where(error, visible & support[:, None])

    def _gain(
        self, out: Reconstruction, error: Tensor, truth: Tensor, support: Tensor | None
    ) -> Float[Tensor, ""]:
        assert out.opinions is not None and out.visible is not None
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
        fused = (out.weights * out.opinions).sum(dim=1, keepdim=True) / self.data_range
        return gain + relative((fused - truth[:, None]).square(), anywhere)
