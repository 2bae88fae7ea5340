"""The support of a volume, a box and a mask of the voxels that may be non-zero, from the views of a
case.
"""

import math
import warnings
from dataclasses import dataclass
from typing import TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.quantities import PositiveFloat, PositiveInt
from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Box, Grid, bounds, filled
from mvrecon.operators.visual_hull.footprints import ray_gap
from mvrecon.operators.visual_hull.hull import expand, thin_witnesses, visual_hull

SUPPORT_KINDS = ("auto", "hull", "box", "none")
#: Share of the grid from which on a hull's box does not pay; "auto" then uses the whole grid.
MAX_BOX_SHARE = 0.7
#: Default number of noisy views that must prove a brick empty.
NOISE_WITNESSES = 3


@dataclass(frozen=True, eq=False)
class Support:
    """The voxels of a volume that may be non-zero.

    Args:
        box: the bounding box of the support of every item of the batch; never empty, so that a grid
            can always be cropped to it.
        mask: the support's voxels on the full grid; None: the whole box.
        kind: "hull", "box" or "none", as given or as "auto" chose.
        fraction: share of the grid's voxels in the mask (mean over the batch), else in the box.
    """

    box: Box
    mask: Bool[Tensor, "b 1 d h w"] | None
    kind: str
    fraction: float


class ViewNoise(TypedDict, total=False):
    """Noise of views, for `support_from_views`.

    Args:
        photons: number of photons of an unattenuated pixel; none: exact views.
        sigmas: standard deviations of the noise, see `noise_threshold`.
        witnesses: views that must agree that a voxel is empty.
    """

    photons: PositiveFloat
    sigmas: PositiveFloat
    witnesses: PositiveInt


def support_from_views(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    kind: str = "auto",
    noise: ViewNoise | None = None,
    brick: int | None = None,
    keep_unseen: bool = True,
) -> Support:
    """Compute the support of volumes from their views' visual hull.

    Views of background only leave no brick: the mask is then empty, and the box is the central
    brick.

    Args:
        views: line integrals.
        cameras, grid: the rig and the voxels.
        kind: "none": the whole grid; "hull": the visual hull; "box": its box; "auto": the hull if
            its box holds less than 0.7 of the grid, else the whole grid.
        noise: noise of the views: none (exact); {photons: I0} of X-rays, with `sigmas` of
            `noise_threshold`. Both also support `witnesses`, the number of views that must agree:
            by default `thin_witnesses`, with photons at least 3.
        brick: edge in voxels; by default `brick_edge`.
        keep_unseen: see `visual_hull`; False gives the support of the visible part only.

    Warns:
        UserWarning: voxels are smaller than the gap of rays, so bodies of that size can be lost.

    Raises:
        ValueError: an unknown kind or noise, explicit rays with a kind other than "none", views of
            a wrong size or not finite.
    """
    if kind not in SUPPORT_KINDS:
        raise ValueError(f"Unknown support {kind!r}. Known: {', '.join(SUPPORT_KINDS)}")
    if kind == "none":
        return Support(Box.whole(grid.shape), None, "none", 1.0)
    rig = _with_frusta(cameras)
    brick = brick_edge(grid) if brick is None else brick
    bricks = _bricks(views, rig, grid, brick, ViewNoise(**noise or {}), keep_unseen)
    return _chosen(kind, expand(bricks, brick, grid.shape), middle(grid, brick))


def hull_mask(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    noise: ViewNoise | None = None,
) -> Bool[Tensor, "b 1 d h w"]:
    """Return the voxels of the views' visual hull, on the views' device, without synchronisation
    with a GPU.

    Args:
        views, cameras, grid, noise: see `support_from_views`, which also returns the box.

    Raises:
        ValueError: as `support_from_views`.
    """
    brick = brick_edge(grid)
    bricks = _bricks(views, _with_frusta(cameras), grid, brick, ViewNoise(**noise or {}), True)
    return expand(bricks, brick, grid.shape)


def support_masks(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    kind: str = "hull",
    noise: ViewNoise | None = None,
) -> Bool[Tensor, "b 1 d h w"]:
    """Return the support of each sample from its own views: its visual "hull", the hull's "box", or
    by "auto" the hull if its box is small, else the whole grid.

    Args:
        views, cameras, grid, noise: see `support_from_views`.
        kind: "hull", "box" or "auto".
    """
    hull = hull_mask(views, cameras, grid, noise)
    if kind == "hull":
        return hull
    box = filled(bounds(hull[:, 0]), hull.shape[2:])[:, None]
    if kind == "box":
        return box
    small = box.flatten(1).sum(dim=1) < MAX_BOX_SHARE * hull[0].numel()
    return hull | ~small.view(-1, 1, 1, 1, 1)


def noise_threshold(
    views: Float[Tensor, "b 1 m v u"], photons: float, sigmas: float = 4.0
) -> Float[Tensor, "b 1 m v u"]:
    """Return the background threshold of X-ray line integrals p: `sigmas` standard deviations of
    the photon noise, exp(p / 2) / sqrt(photons).

    For `visual_hull` of noisy views, with several witnesses. Objects that add less to every ray may
    be lost: at 1e5 photons and 4 sigma p = 0.013, or 0.6 mm of water. Beyond p = 2, where the noise
    grows faster than p, the threshold is constant: a ray with hardly a photon is no sign of
    emptiness.

    Args:
        views: p = -ln(I / I0).
        photons: I0, of an unattenuated pixel.
        sigmas: standard deviations.

    Raises:
        ValueError: photons or sigmas are not positive.
    """
    if not (photons > 0 and sigmas > 0):
        raise ValueError(f"Noise needs positive photons and sigmas, got {photons} and {sigmas}")
    steepest = 2 * math.log(2 * math.sqrt(photons) / sigmas)
    return sigmas * (views.clamp(max=steepest) / 2).exp() / math.sqrt(photons)


def _with_frusta(cameras: Cameras | ExplicitRays) -> Cameras:
    if isinstance(cameras, ExplicitRays):
        raise ValueError(
            "A support is computed from cameras with frusta, got explicit rays; use kind 'none'"
        )
    return cameras


def _warn_of_gaps(cameras: Cameras, grid: Grid) -> None:
    """Warn if voxels are smaller than `ray_gap`: bodies of their size can lie between rays, and be
    missing from a hull.
    """
    gap, size = ray_gap(cameras, grid), min(grid.spacing)
    if size < gap * (1 - 1e-9):
        warnings.warn(
            f"Rays are up to {gap:.3g} mm apart (a pixel's diagonal, magnified), voxels are "
            f"{size:.3g} mm: bodies thinner than {gap:.3g} mm can lie between them, and be cut off "
            f"by a visual hull",
            UserWarning,
            stacklevel=4,
        )


def _chosen(kind: str, mask: Bool[Tensor, "b 1 d h w"], middle: Box) -> Support:
    count = mask.sum(dtype=torch.int64).view(1)
    # all numbers at once: each would synchronise with a GPU
    *ends, voxels = torch.cat([bounds(mask.flatten(0, 1).any(dim=0)[None])[0], count]).tolist()
    whole, box = Box.whole(mask.shape[2:]), Box.of(ends)
    box = box if box.size else middle
    fraction = box.size / whole.size
    if kind == "box":
        return Support(box, None, "box", fraction)
    if kind == "auto" and fraction >= MAX_BOX_SHARE:
        return Support(whole, None, "none", 1.0)
    return Support(box, mask, "hull", voxels / mask.numel())


def brick_edge(grid: Grid) -> int:
    """Edge of a hull's bricks, 1 to 8 voxels: about 32 bricks along the grid's longest axis.

    Footprints exceed their bricks by more than a pixel on every side, so much finer bricks hardly
    sharpen a hull, while their number grows with the third power; operators skip by bricks of 8.
    """
    return min(8, max(1, max(grid.shape) // 32))


def middle(grid: Grid, brick: int | None = None) -> Box:
    """The central brick of a grid, by default of `brick_edge`."""
    d, h, w = (n // 2 for n in grid.shape)
    edge = brick_edge(grid) if brick is None else brick
    return Box((d, h, w), (d + 1, h + 1, w + 1)).aligned(edge, grid.shape)


def _bricks(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    brick: int,
    noise: ViewNoise,
    keep_unseen: bool,
) -> Bool[Tensor, "b z y x"]:
    _warn_of_gaps(cameras, grid)
    photons, witnesses = "photons" in noise, thin_witnesses(len(cameras))
    if not noise.keys() <= ({"photons", "sigmas", "witnesses"} if photons else {"witnesses"}):
        raise ValueError(
            f"Noise is {{witnesses}} of exact views or {{photons}} of X-rays (sigmas, witnesses), "
            f"got {sorted(noise)}"
        )
    least = max(NOISE_WITNESSES, witnesses) if photons else witnesses
    witnesses = noise.get("witnesses", least)
    of_photons = {name: noise[name] for name in ("photons", "sigmas") if name in noise}
    threshold = noise_threshold(views, **of_photons) if photons else 0.0
    return visual_hull(views, cameras, grid, brick, threshold, witnesses, keep_unseen)
