"""The two ends of a network: the classical volume that it starts from, with the scale by which
everything is divided, and the steps towards the data that it ends with, of line integrals and of
counts.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d

from mvrecon.core.numbers import divided
from mvrecon.core.parts import METHODS
from mvrecon.core.registry import check_options
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import inverse_sums, sirt
from mvrecon.methods.learned.geometry import Geometry
from mvrecon.methods.method import check_factor, on_finer_grid


def fingerprints(views: Float[Tensor, "b 1 m v u"]) -> list[bytes]:
    """A name for each sample's views, the same where all bits are; a GPU is waited for once."""
    return [hashlib.sha256(case.numpy().tobytes()).digest() for case in views.detach().cpu()]


#: Iterations of SIRT with momentum, or a classical method: its name and options, and on how many
#: times finer a grid.
Start = int | Mapping[str, Any]
#: The key of that number in the mapping.
FINER = "finer_grid"
#: Bytes of volumes and views that a training keeps at most.
CACHE_BYTES = 2 << 30


class Initialisation(NamedTuple):
    """The classical initialisation of a network.

    Args:
        volume: a classical reconstruction, in the unit of (views / mm).
        grid_residual: views of the volume on a finer grid less those of `volume`: what the grid's
            operator misses of the views, in their unit; None without a finer grid.
    """

    volume: Float[Tensor, "b 1 d h w"]
    grid_residual: Float[Tensor, "b 1 m v u"] | None = None

    @property
    def nbytes(self) -> int:
        """What it takes of memory."""
        return sum(part.nbytes for part in self if part is not None)

    def to(self, other: Tensor) -> "Initialisation":
        """The same with the device and the dtype of another tensor."""
        grid_residual = None if self.grid_residual is None else self.grid_residual.to(other)
        return Initialisation(self.volume.to(other), grid_residual)


class ClassicalStart:
    """The volume that a network begins with, by SIRT with momentum or another method, in the
    unit of (views / mm).

    It is not differentiated. In training another method's volume of a case is computed once
    and kept, as long as there is room: views of a training case are the same in every epoch.

    On a grid n times finer, with n x n rays a pixel, that method finds x_f, and the network
    begins with its mean x over each voxel. Under a grid of few voxels the truth itself misses its
    views by some percent, and every step towards the data pulls there. A_f x_f - A x is an estimate
    of that error, so networks get the views without it.

    Args:
        start: iterations of SIRT with momentum, or a classical method: `{name: ..., **options}`,
            with `finer_grid: n` on a grid n times finer.
        counts: whether the views are counts, which a difference of views is not.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that the method does not have, or a mapping without a name.
        ValueError: a finer grid that is no whole number above 0, or of counts.
    """

    def __init__(self, start: Start, counts: bool = False):
        self.start, self.finer_grid = start, 1
        if isinstance(start, Mapping):
            self.start = {key: value for key, value in start.items() if key != FINER}
            self.finer_grid = start.get(FINER, 1)
            METHODS.check(self.start)
        check_factor(f"{FINER} of a start", self.finer_grid)
        if counts and self.finer_grid > 1:
            raise ValueError(
                f"Expected line integrals for a start with {FINER}: {self.finer_grid}, got counts "
                f"(consistency with the noise poisson)"
            )
        self._known: dict[bytes, Initialisation] = {}
        self._room = CACHE_BYTES

    @torch.no_grad()
    def __call__(
        self, geometry: Geometry, views: Float[Tensor, "b 1 m v u"], training: bool = False
    ) -> Initialisation:
        """The volumes of views within each sample's support, and what their grid misses."""
        if not isinstance(self.start, Mapping):
            A, weights = geometry.A, geometry.weights
            return Initialisation(sirt(A, views, self.start, weights=weights, momentum=True))
        samples = range(len(views))
        if not training:
            return _batch([self._made(geometry, views, sample) for sample in samples])
        names, cases = fingerprints(views), []
        for sample, name in zip(samples, names, strict=True):
            case = self._known.get(name)
            if case is None:
                case = self._made(geometry, views, sample)
                if case.nbytes <= self._room:
                    self._room -= case.nbytes
                    self._known[name] = case.to(torch.empty((), dtype=case.volume.dtype))
            cases.append(case.to(views))
        return _batch(cases)

    def _made(self, geometry: Geometry, views: Tensor, sample: int) -> Initialisation:
        """The method's volume of a sample's views, scaled to a mean density of the rays of
        about one before, so that a weight of its options is relative to the content.
        """
        assert isinstance(self.start, Mapping)
        case, A, fine = views[sample : sample + 1], geometry.A.of_sample(sample), self.finer_grid
        level = content_scale(case) / typical_chord(A.grid)
        mask = None if geometry.support is None else geometry.support[sample, 0]
        if fine == 1:
            within = {} if mask is None else {"support": mask}
            return Initialisation(
                METHODS.from_config(self.start, A, case / level, **within) * level
            )
        B, x = on_finer_grid(A, case / level, fine, self.start, mask)
        mean = avg_pool3d(x * level, fine)
        return Initialisation(mean, B(x * level) - A(mean))


def _batch(cases: list[Initialisation]) -> Initialisation:
    """One case after the other, of a batch."""
    volumes, grid_residual = zip(*cases, strict=True)
    return Initialisation(
        torch.cat(volumes), None if grid_residual[0] is None else torch.cat(grid_residual)
    )


def normalised(
    geometry: Geometry,
    views: Float[Tensor, "b 1 m v u"],
    start: ClassicalStart,
    training: bool = False,
) -> tuple[Float[Tensor, "b 1 k v u"], Float[Tensor, "b 1 d h w"], Float[Tensor, "b 1 1 1 1"]]:
    """Views and their classical start, both divided by the content's scale, and that scale.

    The views are without what the grid misses of them, where a finer one told it. The scale of
    views of nothing is zero.
    """
    x, grid_residual = start(geometry, views, training)
    scale = content_scale(x)
    y = views if grid_residual is None else views - grid_residual
    return y / scale, x / scale, scale * nonzero(views)


def content_scale(volume: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b 1 1 1 1"]:
    """The value of what is there, sum x^2 / sum |x|: v for any object of one value v, however
    small.

    Dividing by it makes a network's answer scale with its input: f(a y) = a f(y). One for an empty
    volume. Relative to the largest value, whose square may be no number of the dtype.
    """
    peak = volume.abs().amax(dim=(1, 2, 3, 4), keepdim=True)
    peak = torch.where(peak > 0, peak, 1.0)
    part = (volume / peak).abs()
    scale = part.square().sum(dim=(1, 2, 3, 4), keepdim=True) / part.sum(
        dim=(1, 2, 3, 4), keepdim=True
    ).clamp_min(1)
    return torch.where(scale > 0, scale * peak, 1.0)


def typical_chord(grid: Grid) -> float:
    """The length in mm by which a network's views are divided, so that it sees densities and no
    unit of length.

    Of the whole grid, since a crop's would change with the crop.
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
