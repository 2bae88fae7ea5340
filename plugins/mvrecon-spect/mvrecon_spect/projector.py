"""Counts behind pinholes.

Along a pixel's line through the pinhole, the cross-section seen by the pixel grows as r^2, which
cancels the 1/r^2 of a point's solid angle. A ray-driven projector thus has no distance-dependent
factor: with lambda in counts / mm^3 and mu in 1/mm,

    counts(u, v) = Blur[ d_e^2 cos^4(phi) du dv / (16 l^2)
                         * integral of lambda(s) exp(-integral_0^s mu) ds ],

with s from the pinhole outward, phi the angle to the pinhole's axis, l the distance from pinhole to
detector, and d_e the pinhole's effective diameter. Integrated over the detector without
attenuation, this is the sensitivity d^2 cos^3(phi) / (16 h^2) for a point source at the distance h
from the pinhole's plane: Van Audenhaege et al., Med. Phys. 42 (2015) 4796.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.registry import check_options
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, subdivided, voxel_centres
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import LinearOperator, PerSample, Projector, Scaled, Wrapped
from mvrecon_spect.attenuated import ACROSS, AttenuatedTransform, with_mu
from mvrecon_spect.blur import BlurredPinholes, Optics
from mvrecon_spect.footprints import Footprints
from mvrecon_spect.hole import Hole
from mvrecon_spect.kernels.ops import SEGMENTS
from mvrecon_spect.kernels.reference import DISTANCE_DRIVEN
from mvrecon_spect.matter import Attenuation, CaseAttenuation, attenuation_on
from mvrecon_spect.rays import (
    GENERATORS,
    RaysPerPixel,
    SeveralRays,
    along_voxels,
    rays_each_way,
    spread,
)
from mvrecon_spect.response import ResponseOption, response_of

#: The method by footprints of voxels; all others go along rays.
FOOTPRINTS = "footprints"


class Shared(TypedDict, total=False):
    """Options of `Hole` and `Drr` that a projector of pinholes passes on.

    Args:
        method: "joseph", "siddon", "distance_driven" (see `AttenuatedTransform`), or without
            attenuation and blur "trilinear". By default "joseph"; "distance_driven" if single rays
            would be more than half a voxel apart, rows of pixels are along the voxels, and
            `rays_per_pixel` is "auto". "footprints" of voxels (see `Footprints`) count a pixel's
            width once and have each camera's sensitivity exactly; of the options below they take
            `backend` and those of the edge.
        backend: as in `RayTransform`.
        skip, support: as in `RayTransform`; not with blur.
        collimator_mu: linear attenuation of the collimator in 1/mm, see `Hole`.
        opening_degrees: full opening angle of the edge, see `Hole`.
        acceptance_degrees: maximum angle of a ray to the pinhole's axis, see `Hole`.
        sensitivity: formula for the effective diameter, "anger" or "paix", see `Hole`.
    """

    method: str
    backend: str
    skip: str
    support: Bool[Tensor, "d h w"] | None
    collimator_mu: float | None
    opening_degrees: float
    acceptance_degrees: float | None
    sensitivity: Literal["anger", "paix"]


class Spect(Scaled):
    """Counts behind pinholes: volumes [b c d h w] in counts / mm^3 to views [b c m v u] in counts.

    For ideal pinholes, counts are the line integrals of `drr` times the sensitivity of each pixel:
    subsets, lists of rays (bins with counts), crops, supports and mirror symmetry (with one ray per
    pixel) cost as much as with `drr`. Attenuation and blur without effect (mu = 0, blur below a
    pixel) are skipped without changing any bit.

    Args:
        grid: grid of the activity.
        cameras: pinholes, each with its detector behind it, perpendicular to its axis.
        diameter_mm: diameter of the pinholes, or the sides (u, v) of rectangular ones.
        mu: linear attenuation in 1/mm: a tensor on the grid, a uniform value, or the path of a
            volume in 1/mm, which is resampled and also attenuates outside the grid; or "case",
            "measured" (the map of each case in training and evaluation) or `{of: case, shift_mm:
            [x, y, z]}`, for which `for_case` returns the operator of a batch. None: no attenuation.
        blur: model the blur by the pinholes' images and the detector's intrinsic resolution.
        intrinsic_mm: FWHM of the detector's intrinsic resolution.
        rays_per_pixel: n; a pixel is the mean of n x n rays, each weighted by its own solid angle,
            before the blur. "auto": rays at most half a voxel apart; one if distance-driven.
        response: of pinhole and detector, with blur and footprints: "geometric", the parameters of
            a crystal, or the path of a table, see `response_of`.
        shared: options of the edge and of `drr`, see `Shared`.

    Warns:
        UserWarning: a grid without support extends behind pinholes, where they see nothing; or
            distance-driven pixels are oblique to the voxels.

    Raises:
        ValueError: cameras whose detectors are not behind a pinhole, a pinhole inside the object or
            with the entire grid on its detector's side, a hole as wide as its distance to the
            detector, an `intrinsic_mm` without blur, or implausible attenuation in 1/mm.
    """

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras,
        diameter_mm: float | Sequence[float] = 2.3,
        mu: Float[Tensor, "d h w"]
        | float
        | Literal["case", "measured"]
        | str
        | Path
        | Mapping[str, Any]
        | None = None,
        blur: bool = False,
        intrinsic_mm: float = 0.0,
        rays_per_pixel: RaysPerPixel = "auto",
        response: ResponseOption = "geometric",
        **shared: Unpack[Shared],
    ):
        check_pinholes(cameras, grid)
        if not 0 <= intrinsic_mm < float("inf"):
            raise ValueError(f"Expected an intrinsic FWHM of 0 mm or more, got {intrinsic_mm}")
        if intrinsic_mm and not blur:
            raise ValueError(
                f"Expected blur=True with an intrinsic FWHM, got {intrinsic_mm} mm and blur={blur}"
            )
        options: dict[str, Any] = {**shared}
        edge = {name: options.pop(name) for name in EDGE if name in options}
        hole = Hole(diameter_mm, **edge)
        hole.check_way(cameras)
        attenuation = CaseAttenuation.of(mu)
        matter = beyond = None
        if attenuation is not None:
            matter = torch.zeros(1).expand(grid.shape)  # until `for_case`
        elif mu is not None:
            matter, beyond = attenuation_on(grid, mu)  # pyrefly: ignore[bad-argument-type]
        if options.get("method") == FOOTPRINTS:
            check_options(f"The method '{FOOTPRINTS}'", options, ("method", "backend"))
            found = response_of(response, hole, cameras, blur, intrinsic_mm)
            warn_of_unseen(cameras, grid)
            own = None if matter is None else Attenuation(matter, grid)
            own = own if beyond is None else Attenuation(beyond.mu, beyond.source)
            A = Footprints(grid, cameras, hole, found, own, options.get("backend", "auto"))
            super().__init__(OfCases(A) if attenuation else A)
            self._of(hole, diameter_mm, attenuation)
            return
        if response != "geometric":
            raise ValueError(
                f"Expected method='{FOOTPRINTS}' with the response {response!r}, got "
                f"{options.get('method', 'the default')!r}"
            )
        optics = Optics(hole, float(intrinsic_mm), beyond)
        warn_of_unseen(cameras, grid, options.get("support"))
        rays = rays_each_way(rays_per_pixel, cameras, grid)
        if "method" not in options:
            wide = rays_per_pixel == "auto" and rays > 1 and along_voxels(cameras, grid)
            options["method"] = DISTANCE_DRIVEN if wide else "joseph"
        areas = options["method"] == DISTANCE_DRIVEN
        if areas:
            rays = check_areas(rays_per_pixel, cameras, grid)
        weight = None
        if blur and blurs(grid, cameras, optics):
            check_options("The projector 'spect' with blur", options, ("method", "backend"))
            A = BlurredPinholes(grid, cameras, matter, optics, rays_per_pixel=rays, **options)
        elif rays > 1:
            A = _of_several_rays(grid, cameras, matter, optics, rays, options)
        else:
            A = _integrals(grid, cameras, matter, options)
            weight = partial(optics.mean, cameras, ACROSS if areas else 1)
        super().__init__(OfCases(A) if attenuation else A, weight)
        self._of(hole, diameter_mm, attenuation)

    def _of(
        self, hole: Hole, diameter_mm: float | Sequence[float], attenuation: CaseAttenuation | None
    ) -> None:
        self.hole, self.diameter_mm = hole, diameter_mm
        self.case_attenuation, self.per_case = attenuation, attenuation is not None

    @staticmethod
    def warm_up(dtype: torch.dtype) -> None:
        """Call the kernels of attenuated and of blurred rays, for `mvrecon-warmup`."""
        grid, rig = Grid.centred(8, spacing=16.0), dcspect80(pixels=8, columns=[0])
        mu = torch.full(grid.shape, 0.01, dtype=dtype)
        x = torch.rand(1, 1, *grid.shape, dtype=dtype)
        for one in (None, mu):
            A = Spect(grid, rig, mu=one, method=FOOTPRINTS)
            A.T(A(x))
        for method in SEGMENTS:
            for blur in (False, True):
                A = Spect(grid, rig, mu=mu, blur=blur, method=method)
                A.T(A(x))  # the second call with the same rays keeps their transmission
                A = Spect(grid, rig, mu=mu.clone().requires_grad_(), blur=blur, method=method)
                A.T(A(x)).sum().backward()

    def for_case(self, case: Mapping[str, Any]) -> LinearOperator:
        """Operators of the cases of a batch, each with its own attenuation; they share the rays and
        their weights.

        Raises:
            ValueError: cases without the map.
        """
        if self.case_attenuation is None:
            return self
        maps = self.case_attenuation.maps_of(case, self.grid)
        return PerSample([self._of_map(mu) for mu in maps])

    def _of_map(self, mu: Float[Tensor, "d h w"]) -> "Spect":
        other = with_mu(self, attenuation_on(self.grid, mu).mu.to(self.device))
        other.A, other.case_attenuation, other.per_case = other.A.A, None, False
        return other


class OfCases(Wrapped):
    """An operator with per-case attenuation; `Spect.for_case` returns the operator of a batch.

    Args:
        A: the operator without attenuation, which defines the grid, the rig and the sizes.
    """

    def forward(self, x: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        raise TypeError(
            "Expected cases with their own attenuation for mu=case, as in training; give mu a file"
        )

    def adjoint(self, y: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        return self.forward(y)


#: Fraction of the semi-axes of the ellipsoid inscribed in a grid's box: the assumed minimum size of
#: an object.
OBJECT = 0.8
#: Cells per axis of a grid's box whose centres are tested for visibility by the pinholes.
COARSE = 32
#: Options of a hole's edge, see `Hole`.
EDGE = ("collimator_mu", "opening_degrees", "acceptance_degrees", "sensitivity")


def _integrals(
    grid: Grid, cameras: Cameras, mu: Tensor | None, options: Mapping[str, Any]
) -> Projector:
    """Integrals along rays, attenuated if there is mu."""
    if mu is None and options["method"] != DISTANCE_DRIVEN:
        return Drr(grid, cameras, **options)
    mu = torch.zeros(grid.shape) if mu is None else mu
    return AttenuatedTransform(grid, cameras, mu, **options)


def _of_several_rays(
    grid: Grid,
    cameras: Cameras,
    mu: Tensor | None,
    optics: Optics,
    rays: int,
    options: Mapping[str, Any],
) -> Projector:
    """Counts of ideal pinholes with several rays per pixel axis, each with its own weight."""
    A = Scaled(
        _integrals(grid, spread(cameras, rays), mu, options), partial(_share, optics, cameras, rays)
    )
    again = partial(_of_several_rays, cameras=cameras, optics=optics)
    return SeveralRays(A, cameras, rays, partial(_with_finer_voxels, again, grid, rays, options))


def _share(optics: Optics, cameras: Cameras, rays: int) -> Float[Tensor, "r v u"]:
    """Sensitivity of each ray's part of its pixel, counts per line integral in mm^2."""
    return optics.weight(spread(cameras, rays)) / rays**2


def _with_finer_voxels(
    again: Callable[..., Projector],
    grid: Grid,
    rays: int,
    options: Mapping[str, Any],
    factor: int,
    mu: Tensor | None,
) -> Projector:
    """The operator built by `again` on a refined grid, with correspondingly more rays."""
    finer = {**options}
    if (support := finer.get("support")) is not None:
        finer["support"] = subdivided(support, factor)
    return again(
        grid.refined(factor),
        mu=None if mu is None else subdivided(mu, factor),
        rays=min(factor * rays, len(GENERATORS)),
        options=finer,
    )


def blurs(grid: Grid, cameras: Cameras, optics: Optics) -> bool:
    """Whether a hole's image or the detector's intrinsic FWHM exceeds a pixel anywhere."""
    pixel = min(cameras.u.detach().norm(dim=-1).min(), cameras.v.detach().norm(dim=-1).min())
    depth = -cameras.depth_range(grid)[:, 1].detach() / cameras.distance.detach()
    image = max(optics.hole.blurring_mm) * (1 + 1 / depth)
    return bool((depth <= 0).any() or image.max() > pixel or optics.intrinsic_mm > pixel)


def check_pinholes(cameras: Cameras, grid: Grid) -> None:
    """Check that cameras are pinholes outside the object, with the detector behind them.

    Raises:
        ValueError: parallel beams, a wrong extent of the rays, a pinhole inside the ellipsoid
            inscribed in the grid's box (except near its surface), or a pinhole with the entire grid
            on its detector's side, whose views are zero.
    """
    if cameras.extent != "behind" or cameras.parallel:
        kind = "parallel" if cameras.parallel else cameras.extent
        raise ValueError(f"Pinhole SPECT needs central cameras of extent 'behind', got {kind!r}")
    place = cameras.source.detach() - grid.centre.to(cameras.source)
    voxels = place @ torch.linalg.inv(grid.affine[:3, :3]).to(place).T
    place = (voxels / (voxels.new_tensor(grid.size) / 2)).norm(dim=1)
    if (place < OBJECT).any():
        first = int((place < 1).nonzero()[0, 0])
        raise ValueError(
            f"Expected pinholes outside of the grid, got pinhole {first} in it, in the "
            "object; make the grid smaller, or look at mm and cm of camera and grid"
        )
    averted = cameras.depth_range(grid)[:, 0].detach() >= 0
    if averted.any():
        raise ValueError(
            f"Expected the grid in front of every pinhole and its detector behind it, got all of "
            f"the grid on the detector's side of pinhole {int(averted.nonzero()[0, 0])}"
        )


def check_areas(rays_per_pixel: RaysPerPixel, cameras: Cameras, grid: Grid) -> int:
    """Check the options of distance-driven pixels, and return their number of rays, one.

    Raises:
        ValueError: several rays per pixel.

    Warns:
        UserWarning: pixels are oblique to the voxels.
    """
    if rays_per_pixel not in ("auto", 1):
        raise ValueError(
            f"Expected one ray per pixel with method '{DISTANCE_DRIVEN}', which averages over the "
            f"pixel, got rays_per_pixel={rays_per_pixel}"
        )
    if not along_voxels(cameras, grid):
        warnings.warn(
            f"Rows of pixels are oblique to the voxels, whose sensitivity is inaccurate with "
            f"method '{DISTANCE_DRIVEN}'; turn the grid, or use method 'joseph'",
            stacklevel=1,
        )
    return 1


def warn_of_unseen(
    cameras: Cameras, grid: Grid, support: Bool[Tensor, "d h w"] | None = None
) -> None:
    """Warn about possibly nonzero voxels behind a pinhole's plane.

    Warns:
        UserWarning: some pinholes do not see a part of the grid.
    """
    rig = cameras[(cameras.depth_range(grid)[:, 1].detach() > 0).nonzero()[:, 0].tolist() or [0]]
    if support is None:
        # the same points, hence the same message, on any refinement of the grid
        cells = torch.arange(COARSE, dtype=torch.float64)
        places = [(cells + 0.5) * n / COARSE - 0.5 for n in grid.size]
        points = grid.to_world(torch.cartesian_prod(*places)).to(rig.source)
    else:
        z, y, x = [slice(n // COARSE // 2, None, max(n // COARSE, 1)) for n in grid.shape]
        points = voxel_centres(grid)[z, y, x]
        points = points[support[z, y, x].to(points.device)].to(rig.source)
    normal = torch.linalg.inv(rig.frame.detach())[:, 2]  # w of a point is linear in its position
    w = points @ normal.T - (rig.source.detach() * normal).sum(dim=1)
    behind = (w >= 0).double().mean(dim=0)
    if not (behind > 0).any():
        return
    count, most = int((behind > 0).sum()), 100 * behind.max().item()
    warnings.warn(
        f"The grid reaches behind {count} of {len(cameras)} pinholes, which do not see what is "
        f"there: up to {most:.2g} % of the voxels that may hold activity; make the grid smaller, "
        f"or give a support",
        stacklevel=1,  # one place, so that Python shows it once, whoever builds the operators
    )


def sensitivity(cameras: Cameras, diameter_mm: float) -> Float[Tensor, "m v u"]:
    """Sensitivity of each pixel, d^2 cos^4(phi) du dv / (16 l^2) in mm^2: counts per integral."""
    return Hole(diameter_mm).weight(cameras)
