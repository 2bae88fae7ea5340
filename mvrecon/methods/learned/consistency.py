"""Steps towards the data that networks end with, of line integrals and of counts."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.core.registry import check_options
from mvrecon.methods.classical.sirt import inverse_sums
from mvrecon.methods.learned.geometry import Geometry


class _WithinOne(torch.autograd.Function):
    """x within 0 and 1, and the gradient of a descent that stays there."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,), (gradient,) = ctx.saved_tensors, gradients
        outwards = ((x <= 0) & (gradient > 0)) | ((x >= 1) & (gradient < 0))
        return gradient.masked_fill(outwards, 0)


def within_one(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Cut a learned number off at 0 and 1.

    Beyond a bound it has a gradient where that leads back, and none where it leads further out: the
    projected gradient (Bertsekas, IEEE Trans. Autom. Control 21 (1976) 174). By torch's own
    derivative, zero there, a number that has once passed a bound would stay.
    """
    return _WithinOne.apply(x)  # type: ignore[no-any-return]


#: The least number of counts that a pixel is taken to expect, relative to the mean of its case.
LEAST = 0.01
#: How many steps, or a mapping of steps, noise, rule and background.
Steps = int | Mapping[str, Any]


class Consistency(nn.Module):
    """A few learned-length steps towards the data, x + lambda_k C A^T R (y - A x).

    C and R are the inverse column and row sums of A (SIRT, Gregor & Benson 2008), so a step of
    length one is stable for every rig. The steps' lengths are learned, as in ItNet (Genzel et al.
    2022). For counts R is the inverse of those that the volume makes expect, their variance, and C
    the inverse column sums that belong to it, as stable (De Pierro, IEEE Trans. Med. Imaging 14
    (1995) 132).

    The rule "em" is expectation maximisation, x + lambda_k x / s A^T (y / (A x + r) - 1) with s =
    A^T 1 (Shepp & Vardi, IEEE Trans. Med. Imaging 1 (1982) 113). Lengths up to one never lower the
    Poisson likelihood: they lie between x and the maximum of its separable surrogate. At one, and
    without r, a step keeps the counts, <s, x> = sum(y). Lengths are kept within 0 and 1: a
    longer step can empty every voxel of a ray, from where no other leads back, and learned lengths
    would come there. Volumes and views are cut off at zero.

    Args:
        steps: how many; none leaves the volume as it is. Or `{steps: 3, noise: poisson, rule: em}`,
            for counts: noise gaussian, rule gradient and background 0 are the default. The
            background is r of "em", relative to the mean of the views that rays of the mask make.

    Raises:
        TypeError: a mapping with other keys.
        ValueError: a number of steps or a background below 0, another noise or rule, or a rule or a
            background that the noise does not have.
    """

    def __init__(self, steps: Steps):
        super().__init__()
        options: dict[str, Any] = dict(steps) if isinstance(steps, Mapping) else {"steps": steps}
        check_options("Consistency", options, ("steps", "noise", "rule", "background"))
        count, noise = int(options.get("steps", 3)), options.get("noise", "gaussian")
        if count < 0 or noise not in ("gaussian", "poisson"):
            raise ValueError(
                f"Expected 0 consistency steps or more, and the noise gaussian or poisson, got "
                f"{count} and {noise!r}"
            )
        self.poisson = noise == "poisson"
        rule = options.get("rule", "gradient")
        if rule not in ("gradient", "em") or (rule == "em" and not self.poisson):
            raise ValueError(
                f"Expected the rule gradient, or em with the noise poisson, got {rule!r} with "
                f"{noise!r}"
            )
        self.em = rule == "em"
        self.background = float(options.get("background", 0.0))
        if not 0 <= self.background < math.inf or (self.background and not self.em):
            raise ValueError(
                f"Expected a background of 0 or more, with rule em alone, got {self.background}"
            )
        self.lengths = nn.Parameter(torch.ones(count))

    def forward(
        self,
        geometry: Geometry,
        volume: Float[Tensor, "b 1 d h w"],
        views: Float[Tensor, "b 1 m v u"],
    ) -> Float[Tensor, "b 1 d h w"]:
        """The volume after the steps."""
        if self.em and len(self.lengths):
            volume, views = volume.clamp_min(0), views.clamp_min(0)
        for number, length in enumerate(self.lengths):
            expected = geometry.A(volume)
            if self.poisson and not self.em and number == 0:
                geometry = weighted_for_counts(geometry, expected)
            if self.em:
                change = em_change(geometry, volume, views, expected, self.background)
                volume = volume + within_one(length) * change
            else:
                volume = volume + length * geometry.direction(views - expected)
        return volume


def em_change(
    geometry: Geometry,
    volume: Float[Tensor, "b 1 d h w"],
    measured: Float[Tensor, "b 1 m v u"],
    expected: Float[Tensor, "b 1 m v u"],
    background: float = 0.0,
) -> Float[Tensor, "b 1 d h w"]:
    """What expectation maximisation changes of a volume, x / s A^T (y / (A x + r) - 1), in its
    unit; differentiable. A voxel that no ray passes stays.

    Args:
        geometry: with C the inverse column sums of A.
        volume: x, nowhere negative.
        measured: y, nowhere negative.
        expected: A x.
        background: r relative to the mean of y over the rays that meet the mask.
    """
    reached = geometry.row > 0
    if background:
        number = reached.expand_as(measured).sum(dim=(1, 2, 3, 4), keepdim=True).clamp_min(1)
        total = (measured * reached).sum(dim=(1, 2, 3, 4), keepdim=True)
        expected = expected + background * total / number
    # a ray of nothing explains no counts, and all its voxels are zero
    possible = reached & (expected > 0)
    ratio = torch.where(possible, measured / torch.where(possible, expected, 1), 0)
    crossed = geometry.column > 0
    return volume * torch.where(crossed, geometry.column * geometry.A.T(ratio) - 1, 0)


@torch.no_grad()
def weighted_for_counts(geometry: Geometry, expected: Float[Tensor, "b 1 m v u"]) -> Geometry:
    """The geometry with R the inverse of expected counts, and C the inverse column sums of R A, in
    the unit of the volume by that of the views.

    Args:
        geometry: with R and C of SIRT.
        expected: counts; at least a hundredth of the mean of those that rays of the mask make. A
            sample that expects none has weights of zero.
    """
    reached = geometry.row > 0
    number = reached.expand_as(expected).sum(dim=(1, 2, 3, 4), keepdim=True).clamp_min(1)
    total = (expected.clamp_min(0) * reached).sum(dim=(1, 2, 3, 4), keepdim=True)
    row = reached * divided(1.0, expected.maximum(LEAST * total / number))
    column = inverse_sums(geometry.A.T(row * geometry.sums)) * (geometry.column > 0)
    return replace(geometry, row=row, column=column)
