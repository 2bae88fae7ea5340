"""Counts behind pinholes.

With lambda in counts / mm^3 and mu in 1/mm, a detector receives from the voxel at X

    lambda dV  d_e^2 cos^3(phi) / (16 h^2)  exp(-integral of mu from X to the pinhole),

h the distance of X to the pinhole's plane, phi the angle to its axis and d_e the hole's effective
diameter: Van Audenhaege et al., Med. Phys. 42 (2015) 4796. `Footprints` distributes this over
the pixels. Along the line of a pixel of the area du dv, at the distance l behind the pinhole, the
cross-section that the pixel sees grows as r^2, which cancels the 1 / r^2 of a point's solid angle:
without attenuation and blur, a pixel also counts d_e^2 cos^4(phi) du dv / (16 l^2) times the mean
line integral of lambda, which thin rays sample.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial
from typing import Any, Literal, TypedDict, Unpack

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.registry import check_options
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon.operators.drr import Drr
from mvrecon.operators.operator import LinearOperator, PerSample, Scaled, Wrapped
from mvrecon.operators.selection import check_support
from mvrecon_spect.operators.footprints import Footprints, pixel_in_voxels
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.matter import CaseAttenuation, Matter, MuOption, attenuation_on
from mvrecon_spect.operators.response import ResponseOption, response_of, seen_points

#: The methods: footprints of voxels, and the thin ray of each pixel.
FOOTPRINTS, THIN = "footprints", "joseph"


class Shared(TypedDict, total=False):
    """Options of `Spect` that other projectors of pinholes pass on.

    Args:
        response: response of pinhole and detector, with blur: "geometric", the parameters of a
            crystal, or the path of a table, see `response_of`.
        method: "footprints" of voxels, see `Footprints`; or "joseph": the thin ray of each pixel's
            centre, see `Drr`, for plain views of fine voxels and lists of bins.
        backend: see `RayTransform`.
        skip: see `RayTransform`; only with thin rays.
        support: see `RayTransform`.
        collimator_mu: linear attenuation of the collimator in 1/mm, see `Hole`.
        opening_degrees: full opening angle of the edge, see `Hole`.
        acceptance_degrees: maximum angle of a ray to the pinhole's axis, see `Hole`.
        sensitivity: formula for the effective diameter, "anger" or "paix", see `Hole`.
    """

    response: ResponseOption
    method: Literal["footprints", "joseph"]
    backend: str
    skip: str
    support: Bool[Tensor, "d h w"] | None
    collimator_mu: float | None
    opening_degrees: float
    acceptance_degrees: float | None
    sensitivity: Literal["anger", "paix"]


class Spect(Scaled):
    """Counts behind pinholes: volumes [b c d h w] in counts / mm^3 to views [b c m v u] in counts.

    Args:
        grid: grid of the activity.
        cameras: pinholes, each with its detector behind it, perpendicular to its axis.
        diameter_mm: diameter of the pinholes, or the sides (u, v) of rectangular ones.
        mu: linear attenuation in 1/mm: a tensor on the grid, a uniform value, or the path of a
            volume in 1/mm, which also attenuates outside the grid; or "case", "measured" (the map
            of each case in training and evaluation) or `{of: case, shift_mm: [x, y, z]}`, for
            which `for_case` returns the operator of a batch. None: no attenuation.
        blur: model the blur by the pinholes' images and the detector; without it a voxel's view is
            that of an ideal pinhole of the same sensitivity.
        intrinsic_mm: FWHM of the detector's intrinsic resolution.
        shared: response, the hole's edge and the method, see `Shared`.

    Warns:
        UserWarning: a grid without support extends behind pinholes, where they see nothing, or is
            seen beside the cone of a hole's edge.

    Raises:
        ValueError: cameras whose detectors are not behind a pinhole, a pinhole inside the object or
            with the entire grid on its detector's side, a hole as wide as its distance to the
            detector, an `intrinsic_mm` or a response without blur, implausible attenuation in
            1/mm, or thin rays with blur, attenuation or pixels wider than a voxel's image.
    """

    emission = True

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras,
        diameter_mm: float | Sequence[float] = 2.3,
        mu: MuOption = None,
        blur: bool = False,
        intrinsic_mm: float = 0.0,
        **shared: Unpack[Shared],
    ):
        check_options("The projector 'spect'", shared, Shared.__annotations__, "projector")
        check_pinholes(cameras, grid)
        options: dict[str, Any] = {**shared}
        response = options.pop("response", "geometric")
        edge = {name: options.pop(name) for name in EDGE if name in options}
        hole = Hole(diameter_mm, **edge)
        hole.check_way(cameras)
        found = response_of(response, hole, cameras, grid, blur, intrinsic_mm)
        support = check_support(options.get("support"), grid.shape)
        attenuation, weight = CaseAttenuation.of(mu), None
        if (method := options.pop("method", FOOTPRINTS)) == FOOTPRINTS:
            check_options(f"The method '{FOOTPRINTS}'", options, ("backend", "support"))
            matter = None if mu is None else Matter(torch.zeros(1).expand(grid.shape), grid)
            if attenuation is None and not (mu is None or isinstance(mu, Mapping)):
                matter = attenuation_on(grid, mu)  # that of a case is zero until `for_case`
            A = Footprints(grid, cameras, hole, found, matter, options.get("backend", "auto"))
        else:
            check_thin(method, cameras, grid, blur, mu is not None)
            A, support = Drr(grid, cameras, method=method, **options), None
            weight = partial(hole.weight, cameras)
        warn_of_unseen(cameras, grid, options.get("support"))
        warn_of_rim(hole, cameras, grid)
        super().__init__(OfCases(A) if attenuation else A, weight, support)
        self.diameter_mm, self.hole = diameter_mm, hole
        self.case_attenuation = attenuation

    def __setattr__(self, name: str, value: Any) -> None:
        if name in FIXED and "hole" in vars(self):
            raise AttributeError(
                f"Expected another Spect(grid, cameras, {name}=...), got a new {name} of a built "
                f"one, whose tables would not follow it"
            )
        super().__setattr__(name, value)

    @staticmethod
    def warm_up(dtype: torch.dtype) -> None:
        """Call the kernels of footprints, for `mvrecon-warmup`."""
        grid, rig = Grid.centred(8, spacing=16.0), dcspect80(pixels=8, columns=[0])
        for mu in (None, torch.full(grid.shape, 0.01, dtype=dtype)):
            A = Spect(grid, rig, mu=mu)
            A.T(A(torch.rand(1, 1, *grid.shape, dtype=dtype)))

    def for_case(self, case: Mapping[str, Any]) -> LinearOperator:
        """Operators of the cases of a batch, each with its own attenuation; they share the rest.

        Raises:
            ValueError: cases without the map.
        """
        if self.case_attenuation is None:
            return self
        maps = self.case_attenuation.maps_of(case, self.grid)
        return PerSample([self._of_map(mu) for mu in maps])

    def _of_map(self, mu: Float[Tensor, "d h w"]) -> "Spect":
        other = copy(self)
        checked = attenuation_on(self.grid, mu).mu
        other._modules = {**self._modules, "A": self.A.A.with_mu(checked)}
        other.case_attenuation = None
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
#: Tolerance of the width of a pixel in voxels, and of the cosine between rows and columns.
WIDER, SKEW = 1e-6, 0.01
#: Degrees beyond a hole's edge without a warning.
RIM_DEGREES = 1.0
#: Options of a hole's edge, see `Hole`.
EDGE = ("collimator_mu", "opening_degrees", "acceptance_degrees", "sensitivity")
#: Options that determine the tables of an operator, which assignment would not change.
FIXED = {"mu", "diameter_mm", "blur", "intrinsic_mm", "response", "method", "hole", *EDGE}


def check_pinholes(cameras: Cameras, grid: Grid) -> None:
    """Check that cameras are pinholes outside the object, with the detector behind them.

    Raises:
        ValueError: parallel beams, a wrong extent of the rays, pixels that are not rectangular, a
            pinhole inside the ellipsoid inscribed in the grid's box (except near its surface), or a
            pinhole with the entire grid on its detector's side, whose views are zero.
    """
    if cameras.extent != "behind" or cameras.parallel:
        kind = "parallel" if cameras.parallel else cameras.extent
        raise ValueError(f"Pinhole SPECT needs central cameras of extent 'behind', got {kind!r}")
    skew = torch.cosine_similarity(cameras.u.detach(), cameras.v.detach(), dim=1).abs()
    if skew.max() > SKEW:
        raise ValueError(
            f"Expected detectors of rectangular pixels, got rows and columns of camera "
            f"{int(skew.argmax())} at {torch.rad2deg(skew.max().acos()).item():.3g} degrees"
        )
    place = cameras.source.detach() - grid.centre.to(cameras.source)
    voxels = place @ torch.linalg.inv(grid.affine[:3, :3]).to(place).T
    place = (voxels / (voxels.new_tensor(grid.size) / 2)).norm(dim=1)
    if (inside := (place < OBJECT).nonzero()[:, 0]).numel():
        raise ValueError(
            f"Expected pinholes outside of the grid, got pinhole {int(inside[0])} in it, in the "
            f"object; make the grid smaller, or look at mm and cm of camera and grid"
        )
    averted = cameras.depth_range(grid)[:, 0].detach() >= 0
    if averted.any():
        raise ValueError(
            f"Expected the grid in front of every pinhole and its detector behind it, got all of "
            f"the grid on the detector's side of pinhole {int(averted.nonzero()[0, 0])}"
        )


def check_thin(method: str, cameras: Cameras, grid: Grid, blur: bool, attenuated: bool) -> None:
    """Check that thin rays sample what is asked for.

    Raises:
        ValueError: another method, blur, attenuation, or pixels wider than a voxel's image at the
            grid's centre.
    """
    if method != THIN:
        raise ValueError(
            f"Expected method '{FOOTPRINTS}', which integrates over pixels of any width, or "
            f"'{THIN}', got {method!r}"
        )
    for asked, name in ((blur, "blur"), (attenuated, "attenuation")):
        if asked:
            raise ValueError(
                f"Expected method '{FOOTPRINTS}' with {name}, which thin rays do not model, got "
                f"{method!r}"
            )
    if (width := pixel_in_voxels(cameras, grid)) > 1 + WIDER:
        raise ValueError(
            f"Expected pixels up to the image of a voxel with the thin rays of method {method!r}, "
            f"got pixels of {width:.3g} voxels; use method '{FOOTPRINTS}'"
        )


def warn_of_unseen(cameras: Cameras, grid: Grid, support: Bool[Tensor, "d h w"] | None) -> None:
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


def warn_of_rim(hole: Hole, cameras: Cameras, grid: Grid) -> None:
    """Warn about voxels seen at angles at which the edge of a hole would block rays.

    Warns:
        UserWarning: some are beyond half of the edge's opening angle.
    """
    least = math.cos(math.radians(hole.opening_degrees / 2 + RIM_DEGREES))
    cosines = 1 - seen_points(cameras, grid).terms[:, 3] if hole.rim else torch.empty(0)
    if (hole.acceptance_degrees or 90.0) > hole.opening_degrees / 2 and (cosines < least).any():
        warnings.warn(
            f"Voxels are seen at more than half of opening_degrees={hole.opening_degrees:g} from a "
            f"pinhole's axis, where the edge blocks rays that are counted; set "
            f"acceptance_degrees={hole.opening_degrees / 2:g}, or a smaller grid",
            stacklevel=1,  # as in `warn_of_unseen`
        )


def sensitivity(cameras: Cameras, diameter_mm: float) -> Float[Tensor, "m v u"]:
    """Sensitivity of each pixel, d^2 cos^4(phi) du dv / (16 l^2) in mm^2: counts per integral."""
    return Hole(diameter_mm).weight(cameras)
