"""Poses and widths of pinholes from measured views of point sources."""

import math
import warnings
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.operators.checks import check_floating
from mvrecon_spect.kernels import reference
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.response import FWHM, TABLE, record_of

#: Edge in mm of the voxel that stands for a point.
POINT = 0.05
#: Scale of the poses' parameters in mm; least width and standard deviation in mm, and least
#: expected counts of a pixel.
SHIFT, LEAST, EMPTY = 1.0, 1e-3, 1e-9


class PointFit(NamedTuple):
    """Cameras, diameter of the hole's image (`Hole.blurring_mm`), FWHM of the intrinsic resolution,
    and activity of each source, in the unit of the counts.
    """

    cameras: Cameras
    blurring_mm: float
    intrinsic_mm: float
    activity: Float[Tensor, " n"]


def fit_point_sources(
    views: Float[Tensor, "n m v u"],
    points: Float[Tensor, "n 3"],
    cameras: Cameras,
    hole: Hole,
    intrinsic_mm: float = 1.0,
    iterations: int = 200,
) -> PointFit:
    """Fit the positions of pinholes and detectors, the width of the holes' images and the intrinsic
    resolution together, to the Poisson likelihood of views of point sources, by L-BFGS.

    Each pinhole moves in all directions, its detector in its plane. The sensitivity is that of
    `hole`; the activities are free. Widths of hole and detector are distinguished by sources at
    several depths.

    Args:
        views: counts of each source, without background.
        points: positions in mm.
        cameras: rig to start from.
        hole: pinhole to start from.
        intrinsic_mm: FWHM to start from.
        iterations: maximum number of iterations of L-BFGS.

    Raises:
        ValueError: views of another shape, counts that are negative or not finite, or a source
            without counts.

    Warns:
        UserWarning: the fit has not converged; its widths may be far off.
    """
    expected = (len(points), len(cameras), *cameras.shape)
    if tuple(views.shape) != expected:
        raise ValueError(f"Expected views of sizes {expected}, got {tuple(views.shape)}")
    check_floating(views, "views")
    if not views.isfinite().all() or (views < 0).any() or not (views.sum(dim=(1, 2, 3)) > 0).all():
        raise ValueError("Expected finite counts, zero or more, of which each source has some")
    counts = views.double()
    grids = [Grid.centred(1, spacing=POINT, centre=point.tolist()) for point in points]
    across = torch.stack([cameras.u, cameras.v], dim=1)
    across = across / across.norm(dim=-1, keepdim=True)
    pinholes = torch.zeros(len(cameras), 3, dtype=torch.float64, requires_grad=True)
    planes = torch.zeros(len(cameras), 2, dtype=torch.float64, requires_grad=True)
    start = [max(max(hole.blurring_mm), LEAST), max(intrinsic_mm / FWHM, LEAST)]
    widths = torch.tensor(start, dtype=torch.float64).log().requires_grad_()

    def moved() -> Cameras:
        shift = torch.einsum("mk,mkx->mx", SHIFT * planes, across)
        return replace(
            cameras, source=cameras.source + SHIFT * pinholes, origin=cameras.origin + shift
        )

    def unit_views() -> Float[Tensor, "n m v u"]:
        rig, (width, sigma) = moved(), widths.exp()
        image = width**2 * width.new_tensor([1.0, 2.0, 1.0, 0.0, 0.0, 0.0])
        rest = width.new_tensor([0.0] * 13 + [1.0, 0.0, 0.0])
        response = torch.cat([image, image, sigma[None] ** 2, rest])
        ones = torch.ones(1, 1, 1, 1, dtype=torch.float64) / POINT**3
        each = [
            reference.project(ones, record_of(rig, grid, hole, response), rig.shape)
            for grid in grids
        ]
        return torch.cat(each)

    def activities(unit: Tensor) -> Tensor:
        return counts.sum(dim=(1, 2, 3)) / unit.sum(dim=(1, 2, 3))  # of the maximum likelihood

    optimiser = torch.optim.LBFGS(
        [pinholes, planes, widths],
        max_iter=iterations,
        max_eval=2 * iterations + 1,  # a line search takes about one each
        line_search_fn="strong_wolfe",
    )

    def loss() -> Tensor:
        optimiser.zero_grad()
        unit = unit_views()
        mean = unit * activities(unit)[:, None, None, None]
        value = (mean - counts * (mean + EMPTY).log()).sum() / counts.sum()
        value.backward()
        return value

    optimiser.step(loss)
    state = optimiser.state[pinholes]
    if state["n_iter"] >= iterations or state["func_evals"] > 2 * iterations:
        warnings.warn(
            f"The fit has not converged after {state['n_iter']} iterations: its widths and "
            f"positions may be far off; expected more iterations, or sources at more depths",
            stacklevel=2,
        )
    with torch.no_grad():
        width, sigma = widths.exp().tolist()
        found = moved()
        rig = replace(found, source=found.source.detach(), origin=found.origin.detach())
        return PointFit(rig, width, FWHM * sigma, activities(unit_views()))


def image_widths(
    views: Float[Tensor, "n m v u"],
    points: Float[Tensor, "n 3"],
    cameras: Cameras,
    hole: Hole,
    least_counts: float = 200.0,
    photons: Float[Tensor, " n"] | None = None,
) -> list[dict[str, float]]:
    """Widths of the images of point sources by depth and angle: the rows of a table that
    `mvrecon_spect.operators.response.measured` reads, a row for each source and pinhole.

    Widths are those of Gaussians with the variances of the images less those of a pixel, radially,
    away from the foot of the pinhole's axis, and tangentially; a standard deviation should be half
    a pixel or more. Images with fewer counts, and those within three standard deviations of the
    detector's edge, are left out.

    Args:
        views: counts of each source, without background.
        points: positions in mm.
        cameras: the pinholes, such as of `fit_point_sources`.
        hole: pinhole whose sensitivity is that of efficiency one.
        least_counts: least number of counts of an image.
        photons: emitted in the measurement, of each source; adds the `efficiency` and the hole's
            `area_mm2`.

    Raises:
        ValueError: no image that is whole.
    """
    rows, columns = cameras.shape
    pitch = torch.stack([cameras.u.norm(dim=1), cameras.v.norm(dim=1)], dim=1)
    across = torch.stack([cameras.u, cameras.v], dim=1) / pitch[:, :, None]
    normal = torch.linalg.cross(across[:, 0], across[:, 1])
    index = pixel_centres(cameras.shape)
    end, table = index.new_tensor([columns - 1, rows - 1]), []
    for s, point in enumerate(points.double()):
        for c, counts in enumerate(views[s].double()):
            total = counts.sum().item()
            if total < least_counts:
                continue
            offset = point - cameras.source[c]
            depth = (offset @ normal[c]).abs().item()
            cosine = depth / offset.norm().item()
            share = counts / total
            middle = torch.einsum("vu,vuk->k", share, index)
            apart = (index - middle) * pitch[c]
            spread = torch.einsum("vu,vuj,vuk->jk", share, apart, apart)
            edge = 3 * spread.diagonal().sqrt() / pitch[c]
            if (middle < edge).any() or (middle > end - edge).any():
                continue
            spread = spread - torch.diag(pitch[c] ** 2) / 12
            away = across[c] @ offset
            radial = away / away.norm() if away.norm() > 0 else away.new_tensor([1.0, 0.0])
            tangential = torch.stack([-radial[1], radial[0]])
            variances = [(d @ spread @ d).item() for d in (radial, tangential)]
            if min(variances) <= 0:
                continue
            widths = (FWHM * variance**0.5 for variance in variances)
            degrees = math.degrees(math.acos(min(cosine, 1)))
            row = dict(zip(TABLE, (depth, degrees, *widths), strict=True))
            row["distance_mm"] = cameras.distance[c].item()
            if photons is not None:
                law = photons[s].item() * hole.area_mm2 * cosine**3 / (4 * math.pi * depth**2)
                row |= {"efficiency": total / law, "area_mm2": hole.area_mm2}
            table.append(row)
    if not table:
        raise ValueError(
            f"Expected images of {least_counts:g} counts or more, away from the detectors' edges, "
            f"got none"
        )
    return table
