"""Contrast recovery and background variability, contrast-to-noise ratio, bias of counts, and defect
contrast.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.grid import Grid


class Recovery(NamedTuple):
    """Results for hot or cold spheres, dimensionless.

    Args:
        contrast: recovery coefficient of each sphere; 1 is ideal.
        variability: standard deviation over background regions of the sphere's size, relative to
            their mean.
    """

    contrast: Float[Tensor, " n"]
    variability: Float[Tensor, " n"]


def sphere_recovery(
    volume: Float[Tensor, "d h w"],
    grid: Grid,
    centres: Float[Tensor, "n 3"],
    diameters: Float[Tensor, " n"],
    background: Float[Tensor, "k 3"],
    ratio: float,
) -> Recovery:
    """Contrast recovery and background variability of spheres, dimensionless: (C_H / C_B - 1) /
    (ratio - 1), and SD_B / C_B over regions of the same size.

    NEMA NU 2, section 7.4.1, with balls instead of circles on slices; voxels are weighted by the
    fraction of their volume inside the ball.

    Args:
        volume: activity.
        grid: grid of the volume.
        centres: centres of the spheres, (x, y, z) in mm.
        diameters: diameters of the spheres in mm.
        background: centres of the background regions, (x, y, z) in mm, at least two.
        ratio: true ratio of the spheres' activity to the background's; 0 for cold spheres.

    Raises:
        ValueError: a volume whose shape is not that of the grid, a ratio of 1 or below 0, fewer
            than two regions, or a ball outside the grid.
    """
    if not ratio >= 0 or ratio == 1 or len(background) < 2:
        raise ValueError(
            f"Expected a ratio of at least 0 that is not 1 and two regions or more, got {ratio} "
            f"and {len(background)}"
        )
    contrast, variability = [], []
    for centre, diameter in zip(centres, diameters.tolist(), strict=True):
        hot = ball_means(volume, grid, centre[None], diameter)
        regions = ball_means(volume, grid, background, diameter)
        contrast.append((hot[0] / regions.mean() - 1) / (ratio - 1))
        variability.append(regions.std() / regions.mean())
    return Recovery(torch.stack(contrast), torch.stack(variability))


def ball_means(
    volume: Float[Tensor, "d h w"], grid: Grid, centres: Float[Tensor, "n 3"], diameter: float
) -> Float[Tensor, " n"]:
    """Mean of a volume in balls, in its unit; voxels are weighted by the fraction of their volume
    inside the ball.

    Args:
        volume: values on the grid.
        grid: grid of the volume.
        centres: (x, y, z) in mm.
        diameter: diameter of the balls in mm.

    Raises:
        ValueError: a volume whose shape is not that of the grid, or a ball outside the grid.
    """
    if tuple(volume.shape) != grid.shape:
        raise ValueError(f"Expected a volume of shape {grid.shape}, got {tuple(volume.shape)}")
    means = []
    radii = torch.full((1, 3), diameter / 2, dtype=torch.float64)
    half = diameter / 2 * torch.linalg.inv(grid.affine[:3, :3]).norm(dim=1)
    for centre in centres.double():
        ball = Solids.upright("ellipsoid", centre[None], radii, torch.ones(1))
        share = voxelise(Phantom((ball,)), grid).double()
        apart = (grid.to_index(centre) - grid.centre_index).abs()
        if not (apart + half <= torch.tensor(grid.size) / 2).all():
            raise ValueError(
                f"Expected a ball inside the grid, got one of {diameter:g} mm about "
                f"{centre.tolist()}"
            )
        means.append((share * volume.double()).sum() / share.sum())
    return torch.stack(means)


def contrast_to_noise(
    volume: Float[Tensor, "d h w"],
    object_mask: Bool[Tensor, "d h w"],
    background_mask: Bool[Tensor, "d h w"],
) -> float:
    """Contrast-to-noise ratio: the difference of two regions' means divided by the background's
    standard deviation, dimensionless.

    Raises:
        ValueError: a mask of the wrong shape, or with fewer than two voxels.
    """
    inside, beside = (_values(volume, mask) for mask in (object_mask, background_mask))
    return float((inside.mean() - beside.mean()) / beside.std())


def count_bias(
    volume: Float[Tensor, "d h w"], truth: Float[Tensor, "d h w"], mask: Bool[Tensor, "d h w"]
) -> float:
    """Relative bias of the counts in a region, dimensionless.

    Raises:
        ValueError: a mask of the wrong shape, with fewer than two voxels, or without true counts.
    """
    total = _values(truth, mask).sum().item()
    if not total > 0:
        raise ValueError(f"Expected true counts in the region, got {total}")
    return _values(volume, mask).sum().item() / total - 1


def defect_contrast(
    volume: Float[Tensor, "d h w"], defect: Bool[Tensor, "d h w"], normal: Bool[Tensor, "d h w"]
) -> float:
    """Contrast of a defect, 1 - (mean of the defect) / (mean of normal myocardium), dimensionless:
    0 means no defect, 1 no activity in the defect.

    Raises:
        ValueError: a mask of the wrong shape, or with fewer than two voxels.
    """
    return 1 - (_values(volume, defect).mean() / _values(volume, normal).mean()).item()


def _values(volume: Tensor, mask: Tensor) -> Float[Tensor, " n"]:
    if mask.dtype != torch.bool or mask.shape != volume.shape or int(mask.sum()) < 2:
        count = int(mask.sum())
        raise ValueError(
            f"Expected a mask of shape {tuple(volume.shape)} with two voxels or more, got "
            f"{mask.dtype} {tuple(mask.shape)} with {count}"
        )
    return volume[mask].double()
