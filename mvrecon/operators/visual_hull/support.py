"""The support of a volume: the voxels that may be non-zero, as a box and a mask, computed from the
views of a case.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.grid import Box, Grid, bounds, filled
from mvrecon.operators.visual_hull.footprints import ray_gap
from mvrecon.operators.visual_hull.hull import expand, thin_witnesses, visual_hull
from mvrecon.operators.visual_hull.noise import WITNESSES, Evidence, bounded_hull, noise_threshold

KINDS = ("auto", "hull", "box", "none")
#: Share of the grid from which on a hull's box is not worth the work on it: "auto" then takes all
#: of the grid.
WORTH = 0.7


@dataclass(frozen=True, eq=False)
class Support:
    """The voxels of a volume that may be non-zero.

    Args:
        box: the least box of voxels around the support of every item of the batch; never empty, so
            that a grid can always be cropped to it.
        mask: the support's voxels on the full grid; None where all of the box counts.
        kind: "hull", "box" or "none", as asked for or as "auto" chose.
        fraction: of the grid's voxels, those in the mask (the mean over the batch), or else in the
            box.
        evidence: with what tolerance and probability the rest is empty; None where the hull is
            exact, or comes from a threshold of some sigma.
    """

    box: Box
    mask: Bool[Tensor, "b 1 d h w"] | None
    kind: str
    fraction: float
    evidence: Evidence | None = None


def support_from_views(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    kind: str = "auto",
    noise: Mapping[str, Any] | None = None,
    brick: int | None = None,
    keep_unseen: bool = True,
) -> Support:
    """The support of the volumes behind views, from the views' visual hull.

    Views of background alone leave no brick: the mask is then empty, and the box is the brick at
    the centre.

    Args:
        views: line integrals, or counts.
        cameras, grid: the rig, and where the voxels lie.
        kind: "none" all of the grid; "hull" the visual hull; "box" all of its box; "auto" the hull
            where its box holds less than 0.7 of the grid, else all of the grid.
        noise: of the views: none (exact); {photons: I0} of X-rays, with `sigmas` of
            `noise_threshold`; {sensitivity, tolerance} of counts, with `delta`, as of
            `bounded_hull`. Exact views and X-rays also take
            `witnesses`, the views that must agree: by default `thin_witnesses`, with photons at
                least 3.
        brick: edge in voxels; by default `brick_edge`.
        keep_unseen: as of `visual_hull`; of counts, whether to keep bricks to which no view is
            sensitive. False gives the support of what the views show, not of all that may exist.

    Warns:
        UserWarning: voxels are smaller than the gap between rays, so that bodies of that size can
            be lost.

    Raises:
        ValueError: an unknown kind or noise, explicit rays with a kind but "none", views of a wrong
            size or not finite.
    """
    if kind not in KINDS:
        raise ValueError(f"Unknown support {kind!r}. Known: {', '.join(KINDS)}")
    if kind == "none":
        return Support(Box.whole(grid.shape), None, "none", 1.0)
    rig = _with_frusta(cameras)
    brick = brick_edge(grid) if brick is None else brick
    bricks, evidence = _bricks(views, rig, grid, brick, dict(noise or {}), keep_unseen)
    return _chosen(kind, expand(bricks, brick, grid.shape), middle(grid, brick), evidence)


def hull_mask(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    noise: Mapping[str, Any] | None = None,
) -> Bool[Tensor, "b 1 d h w"]:
    """The voxels of the views' visual hull, on the views' device; a GPU is waited for with counts
    alone.

    Args:
        views, cameras, grid, noise: as of `support_from_views`, which also tells the box.

    Raises:
        ValueError: as `support_from_views`.
    """
    brick = brick_edge(grid)
    bricks, _ = _bricks(views, _with_frusta(cameras), grid, brick, dict(noise or {}), True)
    return expand(bricks, brick, grid.shape)


def support_masks(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras | ExplicitRays,
    grid: Grid,
    kind: str = "hull",
    noise: Mapping[str, Any] | None = None,
) -> Bool[Tensor, "b 1 d h w"]:
    """The support of each sample, by its own views: its visual "hull", that hull's "box", or by
    "auto" the hull where its box is small, else all of the grid.

    Args:
        views, cameras, grid, noise: as of `support_from_views`.
        kind: "hull", "box" or "auto".
    """
    hull = hull_mask(views, cameras, grid, noise)
    if kind == "hull":
        return hull
    box = filled(bounds(hull[:, 0]), hull.shape[2:])[:, None]
    if kind == "box":
        return box
    small = box.flatten(1).sum(dim=1) < WORTH * hull[0].numel()
    return hull | ~small.view(-1, 1, 1, 1, 1)


def _with_frusta(cameras: Cameras | ExplicitRays) -> Cameras:
    if isinstance(cameras, ExplicitRays):
        raise ValueError(
            "A support is computed from cameras with frusta, got explicit rays; use kind 'none'"
        )
    return cameras


def warn_of_gaps(size: float, what: str, cameras: Cameras, grid: Grid, stacklevel: int = 3) -> None:
    """Warn where a size in mm is below `ray_gap`: bodies of that size can lie between rays, and be
    missing from a hull.
    """
    gap = ray_gap(cameras, grid)
    if size < gap * (1 - 1e-9):
        warnings.warn(
            f"Rays are up to {gap:.3g} mm apart (a pixel's diagonal, magnified), {what} are "
            f"{size:.3g} mm: what is "
            f"thinner than {gap:.3g} mm can pass between them, and be cut off by a visual hull",
            UserWarning,
            stacklevel=stacklevel,
        )


def _chosen(
    kind: str, mask: Bool[Tensor, "b 1 d h w"], middle: Box, evidence: Evidence | None
) -> Support:
    count = mask.sum(dtype=torch.int64).view(1)
    # all numbers at once: for each the host would wait for a GPU
    *ends, voxels = torch.cat([bounds(mask.flatten(0, 1).any(dim=0)[None])[0], count]).tolist()
    whole, box = Box.whole(mask.shape[2:]), Box.of(ends)
    box = box if box.size else middle
    fraction = box.size / whole.size
    if kind == "box":
        return Support(box, None, "box", fraction, evidence)
    if kind == "auto" and fraction >= WORTH:
        return Support(whole, None, "none", 1.0)
    return Support(box, mask, "hull", voxels / mask.numel(), evidence)


def brick_edge(grid: Grid) -> int:
    """Edge of the bricks of a hull: about 32 of them fill the grid's longest axis, and they have 1
    to 8 voxels.

    A footprint is wider than its brick by more than a pixel on every side, so that bricks finer
    than a few voxels sharpen a hull little, while their number grows with the third power; and the
    operators skip by bricks of 8.
    """
    return min(8, max(1, max(grid.shape) // 32))


def middle(grid: Grid, brick: int | None = None) -> Box:
    """The brick at a grid's centre, by default of `brick_edge`."""
    d, h, w = (n // 2 for n in grid.shape)
    edge = brick_edge(grid) if brick is None else brick
    return Box((d, h, w), (d + 1, h + 1, w + 1)).aligned(edge, grid.shape)


def _bricks(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    brick: int,
    noise: dict[str, Any],
    keep_unseen: bool,
) -> tuple[Bool[Tensor, "b z y x"], Evidence | None]:
    case = views, cameras, grid, brick
    if "sensitivity" not in noise:
        warn_of_gaps(min(grid.spacing), "voxels", cameras, grid, stacklevel=4)
    enough = thin_witnesses(len(cameras))
    if noise.keys() <= {"witnesses"}:
        return visual_hull(
            *case, witnesses=noise.get("witnesses", enough), keep_unseen=keep_unseen
        ), None
    if "photons" in noise and noise.keys() <= {"photons", "sigmas", "witnesses"}:
        witnesses = noise.pop("witnesses", max(WITNESSES, enough))
        return visual_hull(*case, noise_threshold(views, **noise), witnesses, keep_unseen), None
    if {"sensitivity", "tolerance"} <= noise.keys() <= {"sensitivity", "tolerance", "delta"}:
        bricks, evidence = bounded_hull(*case, **noise)
        return bricks & (
            (noise["sensitivity"] > 0).any(dim=0).to(bricks.device) | keep_unseen
        ), evidence
    raise ValueError(
        "Noise is {witnesses} of exact views, {photons} of X-rays (sigmas, witnesses) or "
        "{sensitivity, tolerance} of "
        "counts (delta), "
        f"got {sorted(noise)}"
    )
