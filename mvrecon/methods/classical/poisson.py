"""The Poisson likelihood of counts, computed from the non-zero bins only where that is faster."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.methods.classical.solver import spread_background
from mvrecon.operators.checks import check_measured
from mvrecon.operators.operator import LinearOperator
from mvrecon.operators.selection import RaySelection, ViewSelection

#: Share of bins with counts up to which a list of rays is faster than whole views, for all rigs and
#: methods: a listed ray takes up to three times as long, and the adjoint of whole views skips zero
#: rays too.
MAX_LIST_SHARE = 0.2


class PoissonLikelihood:
    """The negative log-likelihood of counts given a volume x, sum(ybar - y log ybar) with ybar = A
    x + r.

    Constants in the counts are dropped. Bins without counts need no ray: their second term
    vanishes, and the first sum is <s, x> + sum(r) with the precomputed sensitivity s = A^T 1. This
    is exact, and equals the likelihood of list-mode data (Barrett, White and Parra, JOSA A 14,
    1997). Where most bins hold counts, whole views are used; `why` gives the choice and its reason.

    Expected counts must be positive in every bin with counts; negative voxels are allowed
    otherwise. Build a new object when counts, operator or device change; cameras that require a
    gradient may move.

    Args:
        A: the operator, in counts per unit of the volume.
        counts: measured counts [b c m v u]; rays without counts in the whole batch are skipped.
        background: expected counts r of other origin, one number or views that broadcast to the
            counts.
        views: indices of the views to use; all by default.
        skip_zero_bins: skip the rays without counts in the whole batch; False: compute all of these
            views.

    Raises:
        ValueError: a wrong rank, size or device; an empty batch; negative or non-finite counts or
            background.
    """

    def __init__(
        self,
        A: LinearOperator,
        counts: Float[Tensor, "b c m v u"],
        background: float | Float[Tensor, "b c m v u"] = 0.0,
        views: Sequence[int] | None = None,
        skip_zero_bins: bool = True,
    ):
        check_measured(counts, "counts [b c m v u]", A.range_shape, A.device)
        self.A = A
        chosen = range(len(counts[0, 0])) if views is None else views
        self.views = ViewSelection(A.range_shape, chosen)
        measured = to_accumulation_dtype(self.views(counts))
        added = self.views(spread_background(background, counts))
        bins = {"counts": measured, "background": added}
        faults = [(~(x >= 0) | ~x.isfinite()).sum() for x in bins.values()]
        full = (measured != 0).flatten(0, 1).any(dim=0)[None, None]
        *faults, rays = torch.stack([*faults, full.sum()]).tolist()  # one synchronisation
        for what, bad in zip(bins, faults, strict=True):
            if bad:
                raise ValueError(
                    f"Expected {what} that are finite and not negative, got {bad} bins that are not"
                )
        share = rays / max(1, full.numel())
        self.selection, self.why = self._choose(full, share, skip_zero_bins)
        self.bins = A.subset(self.selection)
        self.counts, self.background = (
            self.selection(self.views.T(values)) for values in (measured, added)
        )
        self._added = added.flatten(1).sum(dim=1, dtype=torch.float64)
        self._sensitivity: dict[torch.dtype, Tensor] = {}

    def _choose(
        self, full: Bool[Tensor, "1 1 k v u"], share: float, skip: bool
    ) -> tuple[LinearOperator, str]:
        if not skip:
            return self.views, "all bins: asked for"
        if "subset" not in self.A.capabilities:
            return self.views, f"all bins: {type(self.A).__name__} does not compute rays one by one"
        reason = (
            f"{share:.1%} of the bins hold counts, a list of rays pays up to {MAX_LIST_SHARE:.0%}"
        )
        if share > MAX_LIST_SHARE:
            return self.views, f"all bins: {reason}"
        chosen = self.views.T(full)[0, 0]
        return RaySelection(self.A.range_shape, chosen), f"bins with counts: {reason}"

    def sensitivity(self, dtype: torch.dtype) -> Float[Tensor, "1 1 d h w"]:
        """Return s = A^T 1, the counts per unit in each voxel; recomputed if the cameras require a
        gradient.
        """
        if self.A.pose_gradient or dtype not in self._sensitivity:
            like = self.counts.new_ones((), dtype=dtype)
            chosen = like.expand(1, 1, *self.selection.range_shape).contiguous()
            total = self.bins.T(chosen)
            if self.selection is not self.views:
                # by the same rays as `explained`, which MLEM divides by this: lists round
                # differently
                others = like - self.views(self.selection.T(chosen))
                total = total + self.A.subset(self.views).T(others)
            self._sensitivity[dtype] = total
        return self._sensitivity[dtype]

    def expected(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c *n"]:
        """Return ybar, the expected counts of the computed bins.

        Raises:
            ValueError: a volume of another batch than the counts, or one that makes counts
                impossible.
        """
        expected = self.mean(volume)
        refuse_impossible(int(self.impossible(expected)))
        return expected

    def mean(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c *n"]:
        """Return ybar, in counts, without checking that the counts are possible.

        Raises:
            ValueError: a volume of another batch than the counts.
        """
        if volume.shape[:2] != self.counts.shape[:2]:
            batch = tuple(self.counts.shape[:2])
            raise ValueError(
                f"Expected a volume [b c d h w] with the counts' [b c] {batch}, got "
                f"{tuple(volume.shape)}"
            )
        return self.bins(volume) + self.background

    def impossible(self, expected: Float[Tensor, "b c *n"]) -> Int64[Tensor, ""]:
        """The number of bins with counts but none expected, a tensor on the device."""
        return ((self.counts > 0) & ~(expected > 0)).sum()

    def __call__(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, " b"]:
        """Return the negative log-likelihood of each case, in float64; differentiable in the volume
        and the cameras.

        Raises:
            ValueError: as `expected`.
        """
        expected = self.expected(volume)
        total = (
            (self.sensitivity(expected.dtype) * volume).flatten(1).sum(dim=1, dtype=torch.float64)
        )
        return total + self._added - _logs(self.counts, expected)

    @torch.no_grad()
    def gradient(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """The gradient of the negative log-likelihood, s - A^T (y / ybar).

        Raises:
            ValueError: as `expected`.
        """
        expected = self.expected(volume)
        return self.sensitivity(expected.dtype) - self.bins.T(_ratio(self.counts, expected))

    @torch.no_grad()
    def explained(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """Return A^T (y / ybar) for a non-negative volume; bins with zero expected counts are
        skipped, as all voxels on such a ray are zero and stay zero in a multiplicative step.
        """
        return self.bins.T(_ratio(self.counts, self.mean(volume)))


def refuse_impossible(bins: int) -> None:
    """Raise if bins hold counts where none are expected.

    Args:
        bins: number of such bins.

    Raises:
        ValueError: at least one.
    """
    if bins:
        raise ValueError(
            f"{bins} bins hold counts where the volume and the background allow none: their "
            f"likelihood is zero. Give a background > 0, a grid or support that reaches these "
            f"rays, or a volume with values there"
        )


def negative_log_likelihood(
    counts: Float[Tensor, "b c m v u"], expected: Float[Tensor, "b c m v u"]
) -> Float[Tensor, " b"]:
    """Return the negative log-likelihood sum(ybar - y log ybar), in float64; infinite for
    impossible counts.

    Args:
        counts: y.
        expected: ybar >= 0.
    """
    return expected.flatten(1).sum(dim=1, dtype=torch.float64) - _logs(counts, expected)


def _logs(counts: Tensor, expected: Tensor) -> Float[Tensor, " b"]:
    # a bin with neither counts nor expected counts adds 0, but would have the derivative 0 / 0
    logs = counts * torch.where(counts > 0, expected, 1).double().log()
    return logs.flatten(1).sum(dim=1)


def _ratio(counts: Tensor, expected: Tensor) -> Tensor:
    """y / ybar, and 0 where either is zero."""
    counted = (counts > 0) & (expected > 0)
    return torch.where(counted, counts / torch.where(counted, expected, 1), 0)
