"""The attenuated ray transform: emission along rays, attenuated on its path to the detector."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.weak import WeakTensorKeyDictionary

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.cameras.symmetry import Mirror
from mvrecon.geometry.grid import Box, Grid, subdivided
from mvrecon.kernels.operator import accumulation_dtype, choose_backend, to_accumulation_dtype
from mvrecon.kernels.rays import ops as ray_ops
from mvrecon.operators.memo import kept
from mvrecon.operators.operator import (
    LinearOperator,
    PixelIntegral,
    Projector,
    check,
    check_floating,
)
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import RaySelection, Skipped, verify, within
from mvrecon_spect.kernels import ops, reference
from mvrecon_spect.kernels.reference import DENSE, DISTANCE_DRIVEN

#: Upper bound of linear attenuation in 1/mm in a patient above 70 keV (cortical bone 0.058,
#: titanium 0.07); water and tissue in 1/cm exceed it.
DENSEST = 0.1
#: Maximum bytes of cached transmission, over all operators.
MOST_KEPT = 2**30
#: Rays per axis of a distance-driven pixel, where its mean is computed from rays.
ACROSS = 4
#: Options of `RayTransform` shared by operators for a subset of the cameras.
OPTIONS = ("method", "backend", "rays_per_pixel", "skip", "support")


class AttenuatedTransform(RayTransform):
    """Attenuated integrals along rays, integral of lambda(s) exp(-integral of mu from s to the
    detector) ds, in (unit of lambda) * mm.

    mu is constant on each segment, whose emission is weighted by exp(-A) (1 - exp(-mu D)) / mu,
    with A the sum of mu D between the segment and the detector (Gullberg et al., Phys. Med. Biol.
    30 (1985) 799). A segment is a slab for "joseph" and a cell for "siddon". Differentiable in
    lambda, mu and, with the reference back end, the cameras. "distance_driven" averages over the
    image of the pixel in each slab (De Man & Basu, Phys. Med. Biol. 49 (2004) 2463). Otherwise, for
    zero mu it equals `RayTransform` bit for bit, at the same cost. The CPU skips rays outside the
    bounding box of the emission, and the parts of other rays behind it, without changing any bit;
    `skip="off"` disables this, "verify" compares, all other values mean "auto". From the second
    call on the transmission along the rays is cached, at most 1 GiB over all operators; see
    `kept_transmission`.

    Convention: counts run along a ray towards growing w, see `Cameras`: to the pinhole and the
    detector behind it, or to a collimator's end plane w = 1.

    Args:
        grid, cameras, options: see `RayTransform`; instead of "trilinear", the methods include
            "distance_driven", for cameras with one ray per pixel.
        mu: linear attenuation on the grid, in 1/mm; later changes take effect, also through memory
            that it shares with NumPy.

    Raises:
        ValueError: mu of the wrong shape, negative, not finite, or in another unit; or see
            `RayTransform`.
    """

    mu: Tensor

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras | ExplicitRays,
        mu: Float[Tensor, "d h w"],
        **options: Any,
    ):
        areas = options.get("method") == DISTANCE_DRIVEN
        if areas:
            options["method"] = "joseph"
        super().__init__(grid, cameras, **options)
        if self.method.startswith("trilinear"):
            raise ValueError(
                f"Attenuated rays need method 'joseph', 'siddon' or '{DISTANCE_DRIVEN}', got "
                f"{self.method!r}"
            )
        if areas and (isinstance(cameras, ExplicitRays) or self.rays_per_pixel > 1):
            raise ValueError(f"Method '{DISTANCE_DRIVEN}' needs cameras, with one ray per pixel")
        if areas:
            self.method = self.kernel = DISTANCE_DRIVEN
        check_mu(mu, grid)
        self.register_buffer("mu", mu.to(self.device), persistent=False)
        self.longest = sum(grid.spacing)  # no segment in a slab or a cell is longer
        _ = self.clear

    @property
    def clear(self) -> bool:
        """Whether mu is zero everywhere and requires no gradient; as at the last call in
        `torch.compile` graphs.
        """
        if not torch.compiler.is_compiling():
            self._clear = not self.mu.requires_grad and is_zero(self.mu)
        return self._clear

    @property
    def plain(self) -> bool:
        """Whether `RayTransform` computes the same: rays without attenuation."""
        return self.method != DISTANCE_DRIVEN and self.clear

    @property
    def skipped(self) -> Skipped:
        """Voxels that the last call skipped, and the reason."""
        report = super().skipped
        if self.plain or report.mode == "off":
            return report
        return replace(report, why="attenuated rays leave out what is beside or behind the box")

    def project_along(
        self,
        volume: Float[Tensor, "b c d h w"],
        lines: Float[Tensor, "r 4 3 k"],
        detector: Sequence[int],
    ) -> Float[Tensor, "n r v u"]:
        """Attenuated integrals along rays in voxel space."""
        if self.plain:
            return super().project_along(volume, lines, detector)
        check(volume, "a volume [b c d h w]", self.domain_shape, self.device)
        check_floating(volume, "a volume")
        x = volume.flatten(0, 1)
        x = to_accumulation_dtype(x if self.support is None else within(x, self.support))
        along = self.ray_extent, list(detector), self.kernel
        rays = lines, lines.new_zeros(len(lines), 1), self.ray_extent, self.longest, list(detector)
        self._last = None
        name, kernels = self._operators(volume, lines)
        if name != "cpu":
            return kernels.project(x, self.mu, *rays, self.kernel)[..., 0]
        if self.skip != "off":
            rays_of_box = (*along[:2], "joseph", "box")  # the box is that of any method
            self._last = ray_ops.occupied(x.detach(), lines.detach(), *rays_of_box)
        dense = self.kernel + DENSE
        method = dense if self.skip == "off" else self.kernel
        kept = kept_transmission(name, x, self.mu, lines, *along)
        views = ops.project(x, self.mu, *rays, method, *kept)[..., 0]
        if self.skip == "verify":
            verify(views, ops.project(x, self.mu, *rays, dense)[..., 0], self.skipped)
        return views

    def backproject_along(
        self, views: Float[Tensor, "n r v u"], lines: Float[Tensor, "r 4 3 k"]
    ) -> Float[Tensor, "n d h w"]:
        """The transpose of `project_along`."""
        if self.plain:
            return super().backproject_along(views, lines)
        rays = lines, lines.new_zeros(len(lines), 1), self.ray_extent, self.longest, self.kernel
        name, kernels = self._operators(views, lines)
        along = self.ray_extent, list(views.shape[2:]), self.kernel
        kept = kept_transmission(name, views, self.mu, lines, *along)
        volumes = kernels.backproject(views[..., None], self.mu, *rays, *kept)
        return volumes if self.support is None else within(volumes, self.support)

    def cropped(self, box: Box, views: Sequence[int] | None = None) -> Projector:
        """The same operator for emission in a box and a subset of the cameras, with the full
        attenuation map.
        """
        if self.plain:
            return super().cropped(box, views)
        part = self if views is None else self._of_views(list(views))
        return LinearOperator.cropped(part, box)

    def refined(self, factor: int) -> Projector:
        """The same operator on a finer grid, whose voxels inherit the attenuation of the coarse
        voxel.
        """
        if self.plain:
            return super().refined(factor)
        options = {name: getattr(self, name) for name in OPTIONS}
        if self.method != DISTANCE_DRIVEN:
            options["rays_per_pixel"] *= factor
        if self.support is not None:
            options["support"] = subdivided(self.support.cpu(), factor)
        mu = subdivided(self.mu, factor)
        return AttenuatedTransform(self.grid.refined(factor), self.rays, mu, **options).to(
            self.device
        )

    def mirror(self) -> Mirror | None:
        """A mirror plane that is also a symmetry of the attenuation."""
        mirror = super().mirror()
        return mirror if mirror and torch.equal(mirror.volume(self.mu), self.mu) else None

    def mu_map(self) -> Float[Tensor, "d h w"] | None:
        """mu, or None if it is zero everywhere."""
        return None if self.clear else self.mu

    def pixel_integral(self) -> PixelIntegral | None:
        """None unless mu is zero; the mean over a distance-driven pixel, by `ACROSS`^2 rays."""
        own = super().pixel_integral() if self.clear else None
        return own and replace(own, rays=ACROSS if self.method == DISTANCE_DRIVEN else own.rays)

    def subset(self, selection: LinearOperator) -> LinearOperator:
        """The operator of some views or pixels only; distance-driven pixels are computed from full
        views.
        """
        if self.method == DISTANCE_DRIVEN and isinstance(selection, RaySelection):
            return LinearOperator.subset(self, selection)
        return super().subset(selection)

    def _of_views(self, views: list[int]) -> "AttenuatedTransform":
        rig = self.cameras
        options = {name: getattr(self, name) for name in OPTIONS}
        cameras = rig[torch.tensor(views, device=rig.source.device)]
        return AttenuatedTransform(self.grid, cameras, self.mu, **options).to(self.device)

    def _operators(self, tensor: Tensor, lines: Tensor) -> tuple[str, ModuleType]:
        """The back end for a tensor, and its operators."""
        chosen = attenuated_kernels(tensor, self.backend, lines.requires_grad)
        self.last_backend = chosen[0]
        return chosen


def with_mu(A: nn.Module, mu: Float[Tensor, "d h w"]) -> Any:
    """A copy of an operator for another attenuation, which shares all other tensors with it.

    Args:
        A: operator with a buffer `mu`, or around such an operator.
        mu: on its grid and device, in 1/mm; not checked.
    """
    other = copy(A)
    other._buffers = {**A._buffers}
    if "mu" in other._buffers:
        other._buffers["mu"] = mu
    if isinstance(other, AttenuatedTransform):
        _ = other.clear  # of this map
    other._modules = {name: part and with_mu(part, mu) for name, part in A._modules.items()}
    return other


def attenuated_kernels(tensor: Tensor, backend: str, moving: bool) -> tuple[str, ModuleType]:
    """Name of the back end for a tensor, and its operators along attenuated rays; raises the errors
    of `choose_backend`.

    Args:
        tensor: volumes or views.
        backend: see `choose_backend`.
        moving: whether the rays require a gradient, which only the reference supports.
    """
    name = choose_backend(tensor, backend, "attenuated", ops.self_test)
    if moving or name == "reference":
        return "reference", reference
    return name, ops


def is_zero(mu: Float[Tensor, "d h w"]) -> bool:
    """Whether attenuation is zero everywhere; evaluated once, and after changes."""
    return kept(mu, "is zero", lambda: not bool((mu != 0).any()))


#: The transmission that is cached beside maps of attenuation.
_cached: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def kept_transmission(
    name: str,
    like: Tensor,
    mu: Float[Tensor, "d h w"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> tuple[Tensor, ...]:
    """Return the transmission from every ray segment to the detector, the last argument of the CPU
    operators; empty if they recompute it.

    The transmission is cached from the second call with the same rays and mu on, while both exist
    and mu does not change. It has one number per ray and slab of the grid (256
    bytes at 64^3 in float32; three per slab for "siddon"), at most `MOST_KEPT` bytes in total. It
    is not cached in `torch.compile` graphs or if mu requires a gradient.

    Args:
        name: name of the back end.
        like: a tensor with the dtype of the arithmetic.
        mu, lines, window, detector, method: see `ops.project`.
    """
    if name != "cpu" or torch.compiler.is_compiling() or mu.requires_grad:
        return ()
    dtype = accumulation_dtype(like.dtype)
    numbers = len(lines) * math.prod(detector) * max(mu.shape) * ops.SEGMENTS[method]
    size = numbers * dtype.itemsize
    if size > MOST_KEPT:
        return ()
    key = "transmission", dtype, *window, *detector, method
    of_rays: WeakTensorKeyDictionary = kept(mu, key, WeakTensorKeyDictionary)
    if lines not in of_rays:  # the first call
        of_rays[lines] = None
    elif of_rays[lines] is None and kept_bytes() + size <= MOST_KEPT and not is_zero(mu):
        with torch.inference_mode(False):  # training may use tensors cached in inference mode
            along = lines, window, detector, method
            made = ops.transmission(mu.detach().to(dtype), *along)
        of_rays[lines], _cached[made] = made, None
    made = of_rays[lines]
    return () if made is None else (made,)


def kept_bytes() -> int:
    """Bytes currently cached by `kept_transmission`."""
    refs = list(_cached.data)  # a list, as other threads add to it
    return sum(made.nbytes for ref in refs if (made := ref()) is not None)


def check_mu(mu: Tensor, grid: Grid) -> None:
    """Check the shape and the range of linear attenuation in 1/mm.

    Raises:
        ValueError: a wrong shape or dtype, or values that are not finite, negative, or above 0.1 /
            mm.
    """
    if tuple(mu.shape) != tuple(grid.shape):
        raise ValueError(f"Expected mu [d h w] of sizes {grid.shape}, got {tuple(mu.shape)}")
    check_floating(mu, "mu")
    if not mu.isfinite().all():
        raise ValueError("Expected finite attenuation in 1/mm, got values that are not")
    least, most = mu.detach().min().item(), mu.detach().max().item()
    if least < 0:
        raise ValueError(f"Expected attenuation in 1/mm, zero or more, got {least:g}; is it HU?")
    if most > DENSEST:
        raise ValueError(
            f"Expected attenuation in 1/mm, at most {DENSEST:g} (water at 140.5 keV: 0.01536), got "
            f"{most:g}; is it in 1/cm, or HU?"
        )
