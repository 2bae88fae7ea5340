"""The visual hull: the bricks of voxels that may be non-zero, computed from the background pixels
of the views (Laurentini, IEEE PAMI 16, 1994).
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, bricks_along
from mvrecon.kernels import self_test
from mvrecon.kernels.cuda import bricks
from mvrecon.kernels.cuda.bricks import Prints, Rule
from mvrecon.operators.checks import check_finite
from mvrecon.operators.memo import grid_key, kept, place
from mvrecon.operators.visual_hull import footprints

#: Views per pass, of all items of a batch; bricks proved empty are skipped in the next pass.
PASS_VIEWS = 8
#: Diagonals of a pixel by which footprints are grown: 1 proves the absence of bodies at least that
#: thick, 2 covers half as thick bodies of twice the length.
GROWTH_DIAGONALS = 2.0
#: One view in so many must prove a brick empty if bodies may be thinner than the gap of rays.
VIEWS_PER_WITNESS = 10
#: Factor from bricks to coarse bricks, which are tested first; their parts are empty if they are.
COARSE_FACTOR = 4
#: Voxels by which interpolation extends a value beyond the faces of its voxel.
REACH = 0.5


def visual_hull(
    views: Float[Tensor, "b 1 m v u"],
    cameras: Cameras,
    grid: Grid,
    brick: int,
    threshold: float | Float[Tensor, "b 1 m v u"] = 0.0,
    witnesses: int = 1,
    keep_unseen: bool = True,
) -> Bool[Tensor, "b z y x"]:
    """Return the visual hull: the bricks of a non-negative volume that may hold non-zero voxels.

    A brick is empty if at least `witnesses` views that see all of it have no pixel above the
    background threshold in its footprint. Bricks seen partly or not at all stay. With exact views,
    threshold 0 and one witness no occupied brick is lost if the object is nowhere thinner than
    `ray_gap`; else see `thin_witnesses`.

    Args:
        views: line integrals, one per ray, finite; non-finite values on a GPU, where they are not
            checked, count as foreground.
        cameras: the rig.
        grid, brick: the voxels, and the edge of a brick in voxels; the last bricks may be cut.
        threshold: greatest background value; one number, or one per pixel.
        witnesses: number of views that must prove a brick empty.
        keep_unseen: False also drops bricks that no view sees whole and without a pixel above the
            threshold in any view. The data do not determine them: with threshold 0, MLEM and
            non-negative SIRT set them to zero.

    Raises:
        ValueError: views of another size than the rig's or not finite, a NaN threshold, `brick` or
            `witnesses` below one.
    """
    check_measured(views, cameras, on_gpu=False)
    if brick < 1 or witnesses < 1:
        raise ValueError(
            f"Need a brick's edge and witnesses of at least 1, got {brick} and {witnesses}"
        )
    rule = Rule(brick, REACH, witnesses, keep_unseen)
    foreground = _foreground(views, threshold)
    if views.is_cuda and not self_test.failure(views.device, "hull", torch.float64, _self_test):
        return at_once(foreground, cameras, grid, rule)
    return refined(foreground, cameras.to(views.device), grid, rule)


def at_once(
    foreground: Bool[Tensor, "b m v u"],
    cameras: Cameras,
    grid: Grid,
    rule: Rule,
    kept_bricks: Callable[..., Tensor] = footprints.kept_bricks,
) -> Bool[Tensor, "b z y x"]:
    """The bricks that stay, from all bricks and views at once."""

    def moved() -> Prints:
        prints = footprints.prints_of(cameras, grid, GROWTH_DIAGONALS)
        return prints._replace(numbers=prints.numbers.to(foreground.device))

    prints = kept(cameras, ("footprints", grid_key(grid), place(foreground)), moved)
    return kept_bricks(footprints.summed_area_tables(foreground), prints, rule, grid.shape)


def refined(
    foreground: Bool[Tensor, "b m v u"], cameras: Cameras, grid: Grid, rule: Rule
) -> Bool[Tensor, "b z y x"]:
    """The bricks that stay, from coarse to fine, some views at a time."""
    brick, _, witnesses, keep_unseen = rule
    kept = foreground.new_ones((len(foreground), 1, 1, 1))
    edges = [brick]  # as long as a coarse brick is a small part of the grid
    while edges[-1] * COARSE_FACTOR**2 <= max(grid.shape):
        edges.append(edges[-1] * COARSE_FACTOR)
    for edge in reversed(edges):
        counts = bricks_along(grid.shape, edge)
        kept = (
            _repeated(kept, COARSE_FACTOR, counts)
            if kept[0].numel() > 1
            else kept.expand(-1, *counts)
        )
        places = kept.any(dim=0).nonzero()
        empty, dark = _witnesses(foreground, cameras, grid, places, edge, witnesses)
        kept = kept.clone()
        kept[:, *places.T] &= (empty < witnesses) & (~dark | keep_unseen)
    return kept


def thin_witnesses(n_views: int) -> int:
    """Return the number of views, a tenth, that must prove a brick empty so that bodies thinner
    than the gap of rays are not lost.

    If a view misses such a body with probability q, any fixed number of views will all miss it in a
    rig of enough views, but the probability that a share above q misses it falls with their
    number.
    """
    return max(1, n_views // VIEWS_PER_WITNESS)


def expand(
    bricks: Bool[Tensor, "b z y x"], brick: int, shape: Sequence[int]
) -> Bool[Tensor, "b 1 d h w"]:
    """The mask of the voxels in the true bricks of a volume of `shape`."""
    return _repeated(bricks, brick, shape)[:, None]


def check_measured(
    views: Float[Tensor, "b 1 m v u"], cameras: Cameras, on_gpu: bool = True
) -> None:
    """Check that a hull can be computed from views; `on_gpu` as in `check_finite`.

    Raises:
        ValueError: a wrong rank or size, or values that are not finite.
    """
    expected = (1, len(cameras), *cameras.shape)
    if views.ndim != 5 or tuple(views.shape[1:]) != expected:
        raise ValueError(
            f"Expected views [b 1 m v u] with last sizes {expected}, got {tuple(views.shape)}"
        )
    check_finite(views, on_gpu)


def _foreground(
    views: Float[Tensor, "b 1 m v u"], threshold: float | Float[Tensor, "b 1 m v u"]
) -> Bool[Tensor, "b m v u"]:
    # numbers are checked on the host: a tensor of one would be copied to a GPU
    several = isinstance(threshold, Tensor)
    limits = threshold.to(views).expand_as(views) if several else float(threshold)
    asked = not isinstance(limits, Tensor) or limits.is_cpu
    bad = int(torch.as_tensor(limits).isnan().sum()) if asked else 0
    if bad:
        raise ValueError(f"Expected a threshold, got {bad} values that are NaN")
    # non-finite pixels, unchecked on a GPU, prove nothing empty
    return (~(views <= limits) | views.isinf())[:, 0]


def _self_test(device: str, dtype: torch.dtype, purpose: str) -> self_test.Errors:
    """A hull in one launch, from three views of a box of bright pixels."""
    detector = {"pixels": [40, 44], "pixel_mm": 1.0}
    cameras = CAMERAS.build("circular", n_views=3, sid=40.0, sdd=70.0, detector=detector)
    grid = Grid.centred(size=(13, 12, 10), spacing=1.5)
    bright = torch.zeros(1, 3, *cameras.shape, dtype=torch.bool, device=device)
    bright[..., 18:23, 20:24] = True
    rule = Rule(2, REACH, 1, True)
    expected = refined(bright, cameras.to(torch.device(device)), grid, rule)
    stays = at_once(bright, cameras, grid, rule, bricks.kept_bricks)
    yield "hull", self_test.error_of(stays.float(), expected.float())


def _repeated(
    kept: Bool[Tensor, "b z y x"], times: int, shape: Sequence[int]
) -> Bool[Tensor, "b d h w"]:
    for axis, count in enumerate(shape, start=1):
        kept = kept.repeat_interleave(times, dim=axis).narrow(axis, 0, int(count))
    return kept


def _witnesses(
    foreground: Bool[Tensor, "b m v u"],
    cameras: Cameras,
    grid: Grid,
    places: Int[Tensor, "n 3"],
    edge: int,
    enough: int,
) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The number of views that prove a brick empty, counted up to `enough`; and whether no visited
    view has a foreground pixel in the brick's footprint.
    """
    batch, device = len(foreground), foreground.device
    empty = torch.zeros(batch, len(places), dtype=torch.int32, device=device)
    dark = torch.ones_like(empty, dtype=torch.bool)
    undecided = torch.arange(len(places), device=device)
    rounds = -(-len(cameras) // max(1, PASS_VIEWS // batch))
    for turn in range(rounds):
        # far apart on most rigs, so that they differ
        chosen = list(range(turn, len(cameras), rounds))
        table = footprints.summed_area_tables(foreground[:, chosen])
        for some in undecided.split(max(1, footprints.AT_ONCE // (batch * len(chosen)))):
            prints = footprints.footprints(
                cameras[chosen],
                grid,
                footprints.Bricks.at(places[some], edge, grid.shape),
                REACH,
                GROWTH_DIAGONALS,
            )
            proved, unlit = footprints.proofs(table, prints)
            empty[:, some] += proved
            dark[:, some] &= unlit
        undecided = undecided[(empty[:, undecided] < enough).any(dim=0)]
    return empty, dark
