"""Methods, `method(views, A) -> Reconstruction`, classical or learned, and their results.

A registered method is a module class, called as `module(views, A)`, or a function `f(A, views,
**options)` that returns a volume.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool3d, avg_pool3d

from mvrecon.core.numbers import divided
from mvrecon.core.parts import METHODS, PROJECTORS, ClassicalPart, MethodPart
from mvrecon.core.quantities import PositiveInt
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, subdivided
from mvrecon.operators.checks import check, check_floating, check_views
from mvrecon.operators.operator import LinearOperator, Projector


class CameraPrior(NamedTuple):
    """Standard deviations of a camera's expected errors.

    Args:
        shift_px: standard deviation of the shift along each axis, in pixels.
        gain: standard deviation of the relative gain.
    """

    shift_px: float = 1.0
    gain: float = 0.05


#: Errors that alignment assumes by default: shifts of one pixel, gains of 5 %.
DEFAULT_PRIOR = CameraPrior()


@dataclass(frozen=True, eq=False)
class Alignment:
    """Estimated errors of each view, with standard errors.

    Args:
        shift_px: shift of the detector along its columns' and its rows' direction (u, v), in
            pixels.
        gain: factor of the view's values; 0: the view is lost.
        shift_error: standard error of the shifts, in pixels.
        gain_error: standard error of the gains.
    """

    shift_px: Float[Tensor, "b m 2"]
    gain: Float[Tensor, "b m"]
    shift_error: Float[Tensor, "b m 2"]
    gain_error: Float[Tensor, "b m"]

    @classmethod
    def none(cls, views: Float[Tensor, "b 1 m v u"]) -> "Alignment":
        """The alignment of error-free cameras."""
        zero = views.new_zeros(len(views), views.shape[2])
        pair = zero[..., None].expand(-1, -1, 2)
        return cls(pair, zero + 1, pair, zero)

    @classmethod
    def joined(cls, parts: Sequence["Alignment"]) -> "Alignment":
        """Concatenate alignments along the batch."""
        columns = zip(*(one.tensors() for one in parts), strict=True)
        return cls(*(torch.cat(same) for same in columns))

    def split(self) -> list["Alignment"]:
        """The alignment of each sample of the batch."""
        columns = (value.split(1) for value in self.tensors())
        return [Alignment(*parts) for parts in zip(*columns, strict=True)]

    def to(self, *where: Any) -> "Alignment":
        """Move to another device or dtype."""
        return Alignment(*(value.to(*where) for value in self.tensors()))

    def tensors(self) -> list[Tensor]:
        """Shifts, gains, and their errors."""
        return [getattr(self, field.name) for field in fields(self)]

    def deviation(self, prior: CameraPrior = DEFAULT_PRIOR) -> Float[Tensor, "b m"]:
        """Return each camera's deviation, without a unit: shift and gain relative to the prior."""
        shift = (self.shift_px / prior.shift_px).square().sum(dim=-1)
        return (shift + ((self.gain - 1) / prior.gain).square()).sqrt()


@dataclass
class Reconstruction:
    """A reconstructed volume with further results of its method.

    Per-view quantities have the resolution of the method's frusta, in cells of voxels or pixels.

    Args:
        volume: reconstructed volume, in the unit of (views / mm).
        per_view: each camera's own estimate of the volume.
        visible: voxels inside each camera's frustum.
        weights: weight of each camera at each voxel; they sum to one over the cameras that see it.
        ray_weights: factor of each ray's residual; one counts fully.
        predictions: leave-one-out prediction of each view from the other cameras' estimates, in the
            unit of the views.
        binned_views: means of the views over the cells of `predictions`.
        sigma: standard deviation of the error of each voxel, in the unit of the volume.
        support: voxels that may differ from zero; None: all.
        start: the classical initialisation of a network.
        entry: the input of final expectation-maximisation steps, before these hide its scale and
            negative values.
        alignment: shift and gain of each camera, of views that were aligned before.
    """

    volume: Float[Tensor, "b 1 d h w"]
    per_view: Float[Tensor, "b m 1 d h w"] | None = None
    visible: Bool[Tensor, "m 1 d h w"] | None = None
    weights: Float[Tensor, "b m 1 d h w"] | None = None
    ray_weights: Float[Tensor, "b 1 m v u"] | None = None
    predictions: Float[Tensor, "b 1 m v u"] | None = None
    binned_views: Float[Tensor, "b 1 m v u"] | None = None
    sigma: Float[Tensor, "b 1 d h w"] | None = None
    support: Bool[Tensor, "b 1 d h w"] | None = None
    start: Float[Tensor, "b 1 d h w"] | None = None
    entry: Float[Tensor, "b 1 d h w"] | None = None
    alignment: Alignment | None = None

    def split(self) -> list[Self]:
        """The reconstruction of each case of the batch."""
        count = len(self.volume)

        def case(value: Any, i: int) -> Any:
            if isinstance(value, Alignment):
                return value.split()[i]
            return value[i : i + 1] if isinstance(value, Tensor) and len(value) == count else value

        own = [field.name for field in fields(self) if field.name != "visible"]  # of all cases
        return [
            replace(self, **{name: case(getattr(self, name), i) for name in own})
            for i in range(count)
        ]

    @property
    def camera_weights(self) -> Float[Tensor, "b m"] | None:
        """Return the density-weighted mean of each camera's weights over the volume; they sum to
        one. None without weights.
        """
        if self.weights is None:
            return None
        d, h, w = self.weights.shape[-3:]
        density = adaptive_avg_pool3d(self.volume.clamp_min(0), (d, h, w))
        sums = (self.weights * density[:, None]).flatten(2).sum(dim=2)
        return divided(sums, sums.sum(dim=1, keepdim=True))


class Solver(nn.Module):
    """A classical method with its options, as a module without weights.

    Args:
        solve: f(A, views, **options), which returns a volume.
        options: options of the function.

    Raises:
        TypeError, ValueError: at a call, a function that returns anything but a volume on the grid.
    """

    def __init__(self, solve: Callable[..., Tensor], options: Mapping[str, Any]):
        super().__init__()
        self.solve, self.options = solve, dict(options)

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        if not A.per_sample:
            return Reconstruction(self._volume(A, views))
        samples = enumerate(views.split(1))
        return Reconstruction(torch.cat([self._volume(A.of_sample(i), y) for i, y in samples]))

    def _volume(self, A: Projector, views: Tensor) -> Tensor:
        volume = self.solve(A, views, **self.options)
        check_volume(volume, getattr(self.solve, "__name__", "the method"), views, A)
        return volume


def check_volume(volume: Tensor, name: str, views: Tensor, A: LinearOperator) -> None:
    """Check that a method returned a volume on the grid for each sample and channel of the views.

    Raises:
        TypeError, ValueError: anything else; the message names the method.
    """
    check(volume, f"of {name} a volume [b c d h w]", A.domain_shape, views.device)
    check_floating(volume, f"of {name} a volume")
    if volume.shape[:2] != views.shape[:2]:
        raise ValueError(
            f"Expected of {name} a volume of as many samples and channels as the views have, "
            f"{tuple(views.shape[:2])}, got {tuple(volume.shape[:2])}"
        )


def _check_result(
    name: str, method: nn.Module, args: tuple[Any, ...], options: dict[str, Any], out: Any
) -> None:
    """A hook of a method's call, which checks what it returns.

    Raises:
        TypeError, ValueError: no `Reconstruction`, or volumes that are not on the grid.
    """
    views, A, *_ = inspect.signature(method.forward).bind(*args, **options).args
    if not isinstance(out, Reconstruction):
        raise TypeError(
            f"Expected of {name} a Reconstruction, got {type(out).__name__}; "
            f"Reconstruction(volume) makes one of a tensor"
        )
    check_volume(out.volume, name, views, A)
    if out.sigma is not None:
        check_volume(out.sigma, f"{name}, sigma,", views, A)


def build_method(config: MethodPart) -> nn.Module:
    """Build a method from its name and options, `{"name": ..., **options}`; what it returns is
    checked at every call.

    Raises:
        LookupError: an unknown name.
        TypeError: no name, or an option that the method does not have.
    """
    METHODS.check(config)
    name, options = config["name"], {k: v for k, v in config.items() if k != "name"}
    part: Any = METHODS.get(name)
    if not inspect.isclass(part):
        return Solver(part, options)  # checks its volumes itself
    method: Any = part(**options)
    method.register_forward_hook(partial(_check_result, name), with_kwargs=True)
    return method


def reconstruct(
    views: Float[Tensor, "b c m v u"],
    cameras: Cameras,
    grid: Grid,
    method: str = "sirt",
    **options: Any,
) -> Float[Tensor, "b c d h w"]:
    """Reconstruct a volume from views, cameras and a grid, in the unit of (views / mm).

    The operator is `mv.Drr`, or `mv.Radon` for parallel beams, on the views' device.

    Args:
        views: line integrals.
        cameras: the rig that measured them.
        grid: grid of the volume.
        method: name of the method; `mvrecon-list method` lists all, with their options.
        options: options of the method.

    Returns:
        The volume on the grid.

    Raises:
        LookupError: an unknown method; the message gives the nearest name and all names.
        TypeError: an option that the method does not have.
        ValueError: views that do not fit the cameras, or are not finite.

    Examples:
        >>> grid = mv.Grid.centred(8, spacing=4.0)
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> views = mv.Drr(grid, rig)(torch.full((1, 1, 8, 8, 8), 0.02))
        >>> volume = mv.reconstruct(views, rig, grid, method="sirt", iterations=20)
        >>> round(volume.mean().item(), 3)
        0.02
    """
    name = "radon" if cameras.parallel else "drr"
    A = PROJECTORS.build(name, grid=grid, cameras=cameras).to(views.device)
    return build_method({"name": method, **options}).to(views.device)(views, A).volume


#: The default method.
DEFAULT_METHOD = {"name": "sirt", "iterations": 25, "momentum": True}


def finer(
    A: LinearOperator,
    views: Float[Tensor, "b c m v u"],
    fine: PositiveInt = 2,
    method: ClassicalPart | None = None,
    support: Bool[Tensor, "d h w"] | None = None,
) -> Float[Tensor, "b c d h w"]:
    """Reconstruct by another method on a finer grid, with correspondingly denser rays, and average
    its voxels to those of the grid, in the unit of the volume.

    On a coarse grid even the true volume misses its views by some percent, the discretisation error
    of voxels and of one thin ray per pixel. Time and memory grow with fine^3.

    Args:
        A: the operator, with the capability "refine".
        views: the views, in the operator's unit.
        fine: voxels per voxel of the grid, and rays per pixel, along each axis.
        method: name and options of the method; None: 25 iterations of SIRT with momentum.
        support: the voxels of the grid that may differ from zero.

    Returns:
        The volume on the operator's grid.

    Raises:
        ValueError: an operator that cannot be refined, `fine` below 1, and as the method.
        LookupError, TypeError: an unknown method or option.

    Examples:
        >>> rig = mv.circular(8, sid=200, sdd=300, detector={"pixels": [16, 16], "pixel_mm": 6.0})
        >>> A = mv.Drr(mv.Grid.centred(8, spacing=4.0), rig)
        >>> views = A(torch.ones(1, 1, 8, 8, 8))
        >>> mv.finer(A, views, fine=2, method={"name": "cgls", "iterations": 5}).shape
        torch.Size([1, 1, 8, 8, 8])
    """
    if not isinstance(fine, int) or fine < 1:
        raise ValueError(f"Expected fine, a whole number of at least 1, got {fine!r}")
    mask = {} if support is None else {"support": subdivided(support, fine)}
    return avg_pool3d(
        METHODS.from_config(method or DEFAULT_METHOD, A.refined(fine), views, **mask), fine
    )
