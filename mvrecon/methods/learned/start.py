"""Initialisation and final steps of a network: the classical volume that it refines, the intensity
scale of its normalisation, and data-consistency steps for line integrals and counts.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from types import NoneType
from typing import Annotated, Any, Literal, TypedDict

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.numbers import divided
from mvrecon.core.options import check, parts_in
from mvrecon.core.parts import LISTED, METHODS, ClassicalPart
from mvrecon.core.quantities import NonNegativeFloat, NonNegativeInt
from mvrecon.core.registry import check_options
from mvrecon.core.signatures import OptionsOf
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import inverse_sums, sirt, with_ray_weights
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.operators.memo import contents, digest
from mvrecon.operators.operator import Projector

#: Iterations of SIRT with momentum, or name and options of a classical method.
Start = NonNegativeInt | ClassicalPart


#: Types of values of a configuration; others, such as tensors, are given in Python alone.
PLAIN = (str, int, float, NoneType, list, tuple, Mapping)


class _Settings(TypedDict):
    """Settings of `ClassicalStart`."""

    start: Start


#: Maximum bytes of results that `CaseCache` caches.
CACHE_BYTES = 2 << 30


class CaseCache:
    """Results of each case of a training, computed once and cached on the host while memory allows,
    as the views of a training case are the same in every epoch.

    A result is found by the values of all that determine it: the case's tensors, its operator with
    grid, cameras, weights and attenuation, and the options. This synchronises with a GPU once per
    tensor of a case. A copy starts empty.
    """

    def __init__(self) -> None:
        self._known: dict[Hashable, list[Tensor]] = {}
        self._room = CACHE_BYTES

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return CaseCache, ()

    def __call__(
        self,
        make: Callable[[list[int]], Sequence[Tensor]],
        A: Projector,
        options: Any,
        views: Float[Tensor, "b 1 m v u"],
        support: Bool[Tensor, "b 1 d h w"] | None = None,
    ) -> list[Tensor]:
        """Return the results of a batch, in the views' dtype and on their device.

        Args:
            make: computes results [n ...] of n samples from their indices.
            A: the operator.
            options: options of the computation, and the functions that they name.
            views: measured views.
            support: support of each sample; None: all voxels.
        """
        parts: Sequence[Tensor | None] = [None] * len(views) if support is None else list(support)
        names = [
            (contents(A.of_sample(i), options), digest(y), part if part is None else digest(part))
            for i, (y, part) in enumerate(zip(views, parts, strict=True))
        ]
        first = {name: i for i, name in reversed(list(enumerate(names)))}
        new = sorted(i for name, i in first.items() if name not in self._known)
        found = {name: self._known[name] for name in first if name in self._known}
        results = make(new) if new else ()
        for i, *case in zip(new, *(result.split(1) for result in results), strict=True):
            found[names[i]] = case
            size = sum(result.nbytes for result in case)
            if size <= self._room:
                self._room -= size
                self._known[names[i]] = [result.cpu() for result in case]
        columns = zip(*(found[name] for name in names), strict=True)
        return [torch.cat([one.to(views) for one in column]) for column in columns]


class ClassicalStart:
    """The initial volume of a network by SIRT with momentum or another method, in the unit of
    (views / mm).

    In training another method's volume of a case is computed once, see `CaseCache`, unless views
    require a gradient.

    Args:
        start: iterations of SIRT with momentum, or a classical method: `{name: ..., **options}`.

    Raises:
        LookupError: an unknown name.
        TypeError: a learned method, an unknown option or a value of another type, or neither a
            number of iterations nor a mapping with a name.
    """

    def __init__(self, start: Start):
        self.start: Start = int(start) if isinstance(start, np.integer) else start
        plain: Any = self.start
        if isinstance(start, Mapping):
            METHODS.check(start)  # that it has a name, and names of options alone
            plain = {key: value for key, value in start.items() if isinstance(value, PLAIN)}
        check({"start": plain}, _Settings)
        self._cases = CaseCache()

    def __call__(
        self, geometry: Geometry, views: Float[Tensor, "b 1 m v u"], training: bool = False
    ) -> Float[Tensor, "b 1 d h w"]:
        """Return the volumes within each sample's support."""
        if not isinstance(self.start, Mapping):
            A, weights = geometry.A, geometry.weights
            return sirt(A, views, self.start, weights=weights, momentum=True)

        def made(samples: Sequence[int]) -> list[Tensor]:
            alike = geometry.support is None and not geometry.A.per_sample
            parts = [samples] if alike else [[sample] for sample in samples]
            return [torch.cat([self._classical(geometry, views, part) for part in parts])]

        if not training or views.requires_grad:
            return made(range(len(views)))[0]
        # the functions of now: a notebook's cell may have been run again
        parts = parts_in(self.start, ClassicalPart)
        functions = [LISTED[kind].get(node["name"]) for _, kind, node in parts]
        options = self.start, functions
        return self._cases(made, geometry.A, options, views, geometry.support)[0]

    def _classical(
        self, geometry: Geometry, views: Float[Tensor, "b 1 m v u"], samples: Sequence[int]
    ) -> Float[Tensor, "n 1 d h w"]:
        """Run the method on the views of samples with the same operator and support, scaled to a
        mean density of about one, so that a weight among its options is relative to the intensity
        scale.
        """
        assert isinstance(self.start, Mapping)
        cases, A = views[list(samples)], geometry.A.of_sample(samples[0])
        level = content_scale(cases) / typical_chord(A.grid)
        within = {} if geometry.support is None else {"support": geometry.support[samples[0], 0]}
        return METHODS.from_config(self.start, A, cases / level, **within) * level


def normalised(
    geometry: Geometry,
    views: Float[Tensor, "b 1 m v u"],
    start: ClassicalStart,
    training: bool = False,
) -> tuple[Float[Tensor, "b 1 k v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
    """Return views and their classical initialisation, both divided by the intensity scale, and
    that scale, which is zero for zero views.
    """
    x = start(geometry, views, training)
    scale = content_scale(x)
    return views / scale, x / scale, scale * nonzero(views)


def content_scale(volume: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 1 1 1"]:
    """Intensity scale of a volume, sum x^2 / sum |x|: v for any object of uniform value v, however
    small; one for an empty volume.

    Dividing by it makes a network homogeneous, f(a y) = a f(y). Computed relative to the largest
    value, whose square may overflow.
    """
    peak = volume.abs().amax(dim=(1, 2, 3, 4), keepdim=True)
    peak = torch.where(peak > 0, peak, 1.0)
    part = (volume / peak).abs()
    squares, total = (x.sum(dim=(1, 2, 3, 4), keepdim=True) for x in (part.square(), part))
    scale = squares / total.clamp_min(1)
    return torch.where(scale > 0, scale * peak, 1.0)


def typical_chord(grid: Grid) -> float:
    """The length in mm by which a network's views are divided, so that its input does not depend on
    the unit of length.

    Of the whole grid, so that a crop does not change it.
    """
    return max(grid.shape) * min(grid.spacing)


def nonzero(views: Float[Tensor, "b 1 m v u"]) -> Float[Tensor, "b 1 1 1 1"]:
    """One for views with any non-zero value, zero for others, so that f(0) = 0; NaN where a value
    is not finite, which is not checked on a GPU.
    """
    values = views.flatten(1)
    shown = values.any(dim=1).to(views.dtype)
    finite = values.isfinite().all(dim=1)
    return torch.where(finite, shown, torch.nan).reshape(-1, 1, 1, 1, 1)


class _Clamped(torch.autograd.Function):
    """x clamped to [0, most], with a projected gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, most: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.most = most
        return x.clamp(0, most)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (x,), (gradient,) = ctx.saved_tensors, gradients
        outwards = ((x <= 0) & (gradient > 0)) | ((x >= ctx.most) & (gradient < 0))
        return gradient.masked_fill(outwards, 0), None


def clamped(x: Float[Tensor, "*n"], most: float = math.inf) -> Float[Tensor, "*n"]:
    """Clamp learned numbers to [0, most].

    Beyond a bound the gradient passes only where descent leads back (projected gradient: Bertsekas,
    IEEE Trans. Autom. Control 21 (1976) 174); torch's own derivative, zero there, would trap the
    numbers.
    """
    return _Clamped.apply(x, most)  # type: ignore[no-any-return]


#: Lower bound of a pixel's expected counts, relative to the mean of its case.
MIN_EXPECTED_COUNTS = 0.01


class _Steps(TypedDict, total=False):
    """Settings of `Consistency`."""

    steps: NonNegativeInt
    noise: Literal["gaussian", "poisson"]
    rule: Literal["gradient", "em"]
    background: NonNegativeFloat


#: Number of steps, or a mapping of steps, noise, rule and background.
Steps = int | Annotated[Mapping[str, Any], OptionsOf("mvrecon.methods.learned.start:_Steps")]


class Consistency(nn.Module):
    """Data-consistency steps of learned lengths, x + lambda_k C A^T R (y - A x).

    C and R are the inverse column and row sums of A (SIRT, Gregor & Benson 2008), so a step of
    length one is stable for every rig. Lengths are learned, as in ItNet (Genzel et al. 2022). Where
    rays have weights w, R is R w, and lengths are bounded so that steps stay stable. For counts R
    is the inverse of the expected counts, their variance, and C the matching inverse column sums,
    which is as stable (De Pierro, IEEE Trans. Med. Imaging 14 (1995) 132).

    The rule "em" is expectation maximisation, x + lambda_k x / s A^T (y / (A x + r) - 1) with s =
    A^T 1 (Shepp & Vardi, IEEE Trans. Med. Imaging 1 (1982) 113). Lengths up to one never lower the
    Poisson likelihood: they lie between x and the maximum of its separable surrogate. At one, and
    without r, a step preserves the counts, <s, x> = sum(y). Lengths are clamped to [0, 1], as
    longer steps can empty all voxels of a ray for good. Volumes and views are clamped at zero;
    with a background, the gradient still raises a voxel that a network has set below zero. With
    weights w of the rays all this holds for the weighted likelihood: s = A^T w.

    Args:
        steps: number of steps; 0 leaves the volume unchanged. Or `{steps: 3, noise: poisson, rule:
            em}` for counts; defaults are noise gaussian, rule gradient and background 0. The
            background is r of "em", relative to the mean of the views over the rays of the mask.

    Raises:
        TypeError: a mapping with other keys.
        ValueError: negative steps or background, an unknown noise or rule, or a rule or background
            that the noise does not support.
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
        ray_weights: Float[Tensor, "b 1 m v u"] | float = 1.0,
    ) -> Float[Tensor, "b 1 d h w"]:
        """Apply the steps, in which each ray counts by its weight."""
        if self.em and len(self.lengths):
            volume, views = clamped(volume), views.clamp_min(0)
            if isinstance(ray_weights, Tensor):
                column = with_ray_weights(geometry.A, geometry.weights, ray_weights).column
                geometry = replace(geometry, column=column)
        longest = None
        for number, length in enumerate(self.lengths):
            expected = geometry.A(volume)
            if self.em:
                r = self.background
                change = em_change(geometry, volume, views, expected, r, ray_weights)
                volume = volume + clamped(length, most=1.0) * change
                continue
            if number == 0:
                if self.poisson:
                    geometry = weighted_for_counts(geometry, expected)
                if isinstance(ray_weights, Tensor):
                    longest = geometry.longest_step(ray_weights)
            step = length if longest is None else length.minimum(longest)
            volume = volume + step * geometry.direction(views - expected, ray_weights)
        return volume


def em_change(
    geometry: Geometry,
    volume: Float[Tensor, "b 1 d h w"],
    measured: Float[Tensor, "b 1 m v u"],
    expected: Float[Tensor, "b 1 m v u"],
    background: float = 0.0,
    ray_weights: Float[Tensor, "b 1 m v u"] | float = 1.0,
) -> Float[Tensor, "b 1 d h w"]:
    """Change of a volume by expectation maximisation, x / s A^T w (y / (A x + r) - 1), in its unit;
    differentiable. Zero for voxels that no ray passes.

    Args:
        geometry: geometry whose C is the inverse column sums of w A.
        volume: x, non-negative.
        measured: y, non-negative.
        expected: A x.
        background: r relative to the mean of y over the rays that meet the mask.
        ray_weights: w of each ray in the likelihood.
    """
    reached = geometry.row > 0
    if background:
        number = reached.expand_as(measured).sum(dim=(1, 2, 3, 4), keepdim=True).clamp_min(1)
        total = (measured * reached).sum(dim=(1, 2, 3, 4), keepdim=True)
        expected = expected + background * total / number
    # an empty ray explains no counts, and all its voxels are zero
    possible = reached & (expected > 0)
    ratio = torch.where(possible, measured / torch.where(possible, expected, 1), 0)
    crossed = geometry.column > 0
    return volume * torch.where(crossed, geometry.column * geometry.A.T(ray_weights * ratio) - 1, 0)


def reweighted(
    geometry: Geometry,
    volume: Float[Tensor, "b 1 d h w"],
    views: Float[Tensor, "b 1 m v u"],
    ray_weights: Float[Tensor, "b 1 m v u"] | float,
    iterations: int,
) -> Float[Tensor, "b 1 d h w"]:
    """Continue SIRT with momentum with weighted rays, in the unit of the volume.

    It minimises the weighted least squares of iterative reweighting, as `robust_sirt`, and is
    differentiated: weights whose gradients came from later steps alone lost ever more rays.
    """
    weights = geometry.weights
    if isinstance(ray_weights, Tensor):
        weights = with_ray_weights(geometry.A, weights, ray_weights)
    return sirt(geometry.A, views, iterations, weights=weights, momentum=True, start=volume)


def weighted_for_counts(geometry: Geometry, expected: Float[Tensor, "b 1 m v u"]) -> Geometry:
    """Return the geometry with R the inverse of expected counts, and C the inverse column sums of R
    A, in the unit of the volume by that of the views.

    Args:
        geometry: geometry with R and C of SIRT.
        expected: counts, clamped to at least a hundredth of their mean over the rays of the mask. A
            sample that expects none has zero weights.
    """
    reached = geometry.row > 0
    number = reached.expand_as(expected).sum(dim=(1, 2, 3, 4), keepdim=True).clamp_min(1)
    total = (expected.clamp_min(0) * reached).sum(dim=(1, 2, 3, 4), keepdim=True)
    row = reached * divided(1.0, expected.maximum(MIN_EXPECTED_COUNTS * total / number))
    column = inverse_sums(geometry.A.T(row * geometry.sums)) * (geometry.column > 0)
    return replace(geometry, row=row, column=column)
