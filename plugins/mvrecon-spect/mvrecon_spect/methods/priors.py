"""Priors of volumes for `bsrem`: sums of relative differences, squares or log-cosh over pairs of
neighbours, optionally with neighbours selected by an anatomical image.

Each is R = sum w psi(a, b) in the unit of the volume. For values near the level with a small
difference, psi is approximately (a - b)^2 / (2 level), so a weight has a similar effect for all
priors.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

#: Differences up to this part of an anatomy's range are rounding, and values apart by them equal.
TIE = 1e-5
#: Half of the 26 neighbours (z, y, x); the other half follows by symmetry.
HALF = [offset for offset in product((-1, 0, 1), repeat=3) if offset > (0, 0, 0)]


class Potential(NamedTuple):
    """Potential of two neighbouring values a and b.

    Args:
        cost: psi(a, b), in their unit.
        slopes: derivatives with respect to a and b, dimensionless.
        growth: g(x) such that 2 w g(x) / x bounds the curvature of a pair of weight w,
            dimensionless.
    """

    cost: Callable[[Tensor, Tensor], Tensor]
    slopes: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    growth: Callable[[Tensor], Tensor | float]


def relative_difference(gamma: float = 2.0) -> Potential:
    """The relative difference (a - b)^2 / (a + b + gamma |a - b|) of values >= 0, in their unit.

    R(c x) = c R(x), since differences are relative to the values. The potential is quadratic only
    for relative differences below 1 / gamma, which preserves edges (Nuyts, Beque, Dupont,
    Mortelmans, IEEE Trans. Nucl. Sci. 49 (2002) 56). It is convex.

    Args:
        gamma: larger values preserve smaller edges; 0: no edge preservation.

    Raises:
        ValueError: gamma is negative or not finite.
    """
    if not 0 <= gamma < float("inf"):
        raise ValueError(f"Expected a finite gamma of at least 0, got {gamma}")

    def cost(one: Tensor, other: Tensor) -> Tensor:
        apart, size = (one - other).abs(), one + other
        size = size + gamma * apart
        return apart.square() / torch.where(size > 0, size, 1)

    def slopes(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        apart, whole = one - other, one + other
        edge = gamma * apart.abs()
        factor = apart / torch.where(whole > 0, (whole + edge).square(), 1)
        return factor * (one + 3 * other + edge), -factor * (3 * one + other + edge)

    return Potential(cost, slopes, lambda _: 1.0)


def quadratic(level: Float[Tensor, "b c 1 1 1"] | float) -> Potential:
    """The square (a - b)^2 / (2 level), in the unit of the values: smooths noise and edges alike,
    with the same width wherever the sensitivity is the same (Levitan and Herman, IEEE Trans. Med.
    Imaging 6 (1987) 185).

    Args:
        level: a typical value, in the unit of the volume.
    """

    def slopes(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        slope = (one - other) / level
        return slope, -slope

    return Potential(
        lambda one, other: (one - other).square() / (2 * level), slopes, lambda x: x / level
    )


def log_cosh(level: Float[Tensor, "b c 1 1 1"] | float, delta: float = 0.1) -> Potential:
    """delta^2 level log cosh((a - b) / (delta level)), in the unit of the values: quadratic below
    delta level and linear above, which preserves edges (Green, IEEE Trans. Med. Imaging 9 (1990)
    84). It is convex. For small delta it approximates total variation and converges as slowly.

    Args:
        level: a typical value, in the unit of the volume.
        delta: relative difference at which the quadratic range ends.

    Raises:
        ValueError: delta is not positive and finite.
    """
    if not 0 < delta < float("inf"):
        raise ValueError(f"Expected a positive, finite delta, got {delta}")

    def cost(one: Tensor, other: Tensor) -> Tensor:
        # Doubles, as small differences cancel.
        u = (one - other).abs().double() / (delta * level)
        return delta**2 * level * (u + torch.log1p(0.5 * torch.expm1(-2 * u)))

    def slopes(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        slope = delta * torch.tanh((one - other) / (delta * level))
        return slope, -slope

    return Potential(cost, slopes, lambda x: x / level)


class Prior:
    """R = sum w psi(a, b) over pairs of 26-neighbours, in the unit of the volume; w is the inverse
    of their distance in units of the smallest voxel size.

    Args:
        potential: psi.
        steps: voxel size along (z, y, x), in mm.
        mask: the voxels included in the sum.
        anatomy: an image of the same voxels, such as CT: a voxel's neighbours are only the
            `similar` ones with the closest values (Bowsher et al., IEEE Nucl. Sci. Symp. 2004;
            including all ties). A pair has half the weight if only one of the two voxels selects
            the other.
        similar: number of neighbours out of 26 selected by `anatomy`.

    Raises:
        ValueError: an anatomy of the wrong shape or with values that are not finite, or a number of
            similar neighbours outside 1 to 26.
    """

    def __init__(
        self,
        potential: Potential,
        steps: Sequence[float],
        mask: Bool[Tensor, "d h w"],
        anatomy: Float[Tensor, "d h w"] | None = None,
        similar: int = 7,
    ):
        if not 1 <= similar <= 26:
            raise ValueError(f"Expected 1 to 26 similar neighbours, got {similar}")
        self.potential, pairs = potential, []
        guide = None if anatomy is None else (anatomy, _reach(anatomy, mask, similar))
        for offset in HALF:
            if any(abs(o) >= n for o, n in zip(offset, mask.shape, strict=True)):
                continue
            distance = sum((o * s / min(steps)) ** 2 for o, s in zip(offset, steps, strict=True))
            one, other = ends(mask, offset)
            weight = (one & other).to(torch.float32) / distance**0.5
            if guide is not None:
                weight = weight * _chosen(*guide, offset)
            pairs.append((offset, weight))
        # one GPU synchronisation
        some = torch.stack([mask.any(), *(weight.any() for _, weight in pairs)]).tolist()[1:]
        #: The offset (z, y, x) of pairs of voxels, and the weights of all pairs with this offset.
        self.pairs = [pair for pair, any_of_it in zip(pairs, some, strict=True) if any_of_it]
        #: The sum of the weights of each voxel's pairs.
        self.weights = torch.zeros(1, 1, *mask.shape, dtype=torch.float64, device=mask.device)
        for offset, weight in self.pairs:
            for end in ends(self.weights, offset):
                end.add_(weight)

    def __call__(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, " b"]:
        """R of each case in float64, in the unit of the volume; differentiable."""
        total = volume.new_zeros(len(volume), dtype=torch.float64)
        for offset, weight in self.pairs:
            cost = weight.to(volume) * self.potential.cost(*ends(volume, offset))
            total = total + cost.flatten(1).sum(dim=1, dtype=torch.float64)
        return total

    def gradient(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c d h w"]:
        """Derivative of R with respect to each voxel, dimensionless; zero for equal neighbours."""
        slope = torch.zeros_like(volume)
        for offset, weight in self.pairs:
            slopes = self.potential.slopes(*ends(volume, offset))
            for end, by in zip(ends(slope, offset), slopes, strict=True):
                end.addcmul_(weight.to(volume), by)
        return slope

    def bound(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "#b #c d h w"]:
        """Bound of R's curvature times the value of each voxel, by Gershgorin's circle theorem,
        dimensionless.
        """
        return 2 * self.weights.to(volume) * self.potential.growth(volume)


def prior_of(
    options: Mapping[str, Any],
    level: Float[Tensor, "b c 1 1 1"],
    steps: Sequence[float],
    mask: Bool[Tensor, "d h w"],
) -> Prior:
    """Build a prior from its options.

    Args:
        options: name (relative_difference by default, quadratic or log_cosh), options of the
            potential, and anatomy and similar of `Prior`.
        level: a typical value of each case, in the unit of the volume.
        steps: see `Prior`.
        mask: see `Prior`.

    Raises:
        TypeError: an unknown option of the potential.
        ValueError: an unknown name; see `Prior` and the potential.
    """
    potentials: dict[str, Callable[..., Potential]] = {
        "relative_difference": relative_difference,
        "quadratic": partial(quadratic, level),
        "log_cosh": partial(log_cosh, level),
    }
    own = dict(options)
    name = own.pop("name", "relative_difference")
    guide = {key: own.pop(key) for key in ("anatomy", "similar") if key in own}
    if name not in potentials:
        raise ValueError(f"Expected a prior of {', '.join(potentials)}, got {name!r}")
    return Prior(potentials[name](**own), steps, mask, **guide)


def ends(volume: Tensor, offset: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The two voxels of all pairs with an offset (z, y, x), as two windows of a volume."""
    one = other = volume
    for dim, step in zip((-3, -2, -1), offset, strict=True):
        length = volume.shape[dim] - abs(step)
        one = one.narrow(dim, max(0, -step), length)
        other = other.narrow(dim, max(0, step), length)
    return one, other


def _reach(
    anatomy: Float[Tensor, "d h w"], mask: Bool[Tensor, "d h w"], similar: int
) -> Float[Tensor, "d h w"]:
    """Largest anatomical difference between each voxel and its selected neighbours, in the
    anatomy's unit.
    """
    if anatomy.shape != mask.shape or not anatomy.isfinite().all():
        bad = int((~anatomy.isfinite()).sum())
        raise ValueError(
            f"Expected a finite anatomy of shape {tuple(mask.shape)}, got {tuple(anatomy.shape)} "
            f"with {bad} values that are not finite"
        )
    apart = anatomy.new_full((26, *anatomy.shape), torch.inf)
    for n, offset in enumerate(HALF):
        one, other = ends(anatomy, offset)
        difference = (one - other).abs()
        ends(apart[n], offset)[0].copy_(difference)
        ends(apart[n + 13], offset)[1].copy_(difference)
    return apart.kthvalue(similar, dim=0).values + TIE * (anatomy.amax() - anatomy.amin())


def _chosen(
    anatomy: Float[Tensor, "d h w"], reach: Float[Tensor, "d h w"], offset: Sequence[int]
) -> Float[Tensor, "#d #h #w"]:
    """Half the number of a pair's voxels that select the other."""
    one, other = ends(anatomy, offset)
    apart = (one - other).abs()
    by_one, by_other = (apart <= end for end in ends(reach, offset))
    return (by_one.float() + by_other.float()) / 2
