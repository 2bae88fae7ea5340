"""Views that end inside the object: their rows are continued beyond the detector, with a warning.

The ramp filter takes the jump at the edge of a row for a part of the object. Where a beam crosses
one ellipse, whatever its size, place and density, its squared line integrals are a parabola of the
column: p = 2 mu sqrt(R^2 - (s - s0)^2) of a circle. So a parabola is fitted to p^2 in the last
columns, and the row ends where it falls to zero. Hsieh and others (A novel reconstruction algorithm
to extend the CT scan field-of-view, Med. Phys. 31, 2004) continue rows by water cylinders likewise,
from value and slope at the edge and the known attenuation of water, which the curvature replaces.
"""

import math
import warnings

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from mvrecon.core.numbers import SIGMA_PER_MEDIAN, divided, second_differences
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.rigid import unit

#: Share of a row at its end to which the ellipse is fitted, with the least number of columns, and
#: the share whose mean is the value at the edge.
FITTED, MIN_FITTED, EDGE = 0.2, 16, 0.02
#: The share that tells whether the object reaches the edge: one that ends just inside does not; and
#: how many times as many columns beside it tell whether the edge is flat, as air is.
OUTERMOST, BESIDE = 0.01, 3
#: Greatest growth of p^2 beyond the edge, relative, where the ellipse's centre is beyond it.
MAX_GROWTH = 4.0
#: Blocks of rows, and groups of consecutive views, over which the edges of views are averaged.
ROW_BLOCKS, VIEW_GROUPS = 8, 24
#: Greatest value of a row relative to its mean, so that metal does not hide a body's edges; a
#: complete object as wide as a half of the row has less.
MAX_LEVEL = 3.0
#: Edges of all views, relative to their greatest values, from which on they end inside the object:
#: a bottle's holder, or a flat field that is not air's, has less.
CUT_EDGE = 0.05
#: Cosine of a detector's columns with its rows and beams, up to which rows of parallel beams see a
#: slice each: 3 degrees, of which a calibrated tilt has less.
MAX_SLICE_COSINE = 0.05
#: The edge of a single view, which has more noise, from which on its rows are continued. Below it a
#: cylinder reads 0.2 % high at most (study 30).
CONTINUED_EDGE = 0.1
#: Standard deviations of noise beyond which an edge shows an object, and the share of the views
#: that show one from which a warning is given.
MIN_DEVIATIONS, WARNED_VIEWS = 3.0, 0.1
#: The same of the first and the last row of any group of views, and the standard deviations that
#: none of hundreds of means exceeds by chance.
ROW_EDGE, ROW_DEVIATIONS = 0.02, 5.0
#: What air reads is the lower quartile of the edges, or what a flat field does that is a tenth off
#: at most, and this part of the greatest line integral.
AIR_QUANTILE, MAX_AIR, MAX_AIR_SHARE = 0.25, 0.1, 0.5
#: Numbers of the parts of `edges_of`.
PARTS = [2, 2, 2, 1, 1, 2]


def edges_of(
    views: Float[Tensor, "b c k v u"], weights: Float[Tensor, "k #v #u"] | None = None
) -> Float[Tensor, "b c k 10 i"]:
    """What tells whether views end inside the object, in the order of `PARTS`, averaged over blocks
    of rows: the first and the last columns; the columns beside them; their weights relative to the
    view's greatest; the greatest column, at most `MAX_LEVEL` times the mean, and as it is; and the
    standard deviation of the first and the last columns' noise.

    Args:
        views: line integrals.
        weights: weights of the views' pixels, which fall to zero where another view measures the
            same lines, as at one side of a half fan; None: all alike.
    """
    blocks = min(ROW_BLOCKS, views.shape[-2])
    means = torch.stack([part.mean(dim=-2) for part in views.tensor_split(blocks, dim=-2)], dim=-1)
    count = max(1, round(OUTERMOST * views.shape[-1]))
    more = BESIDE * count
    columns = (means[..., :count, :], means[..., -count:, :])
    beside = (means[..., count:, :][..., :more, :], means[..., :-count, :][..., -more:, :])
    ends = torch.stack([part.mean(dim=-2) for part in columns], dim=-2)
    nexts = ends
    noise = torch.zeros_like(ends)
    if views.shape[-1] > 2:
        nexts = torch.stack([part.mean(dim=-2) for part in beside], dim=-2)
        rest = second_differences(means, dim=-2).abs()
        some = max(MIN_FITTED, round(FITTED * views.shape[-1]))
        sides = (rest[..., :some, :], rest[..., -some:, :])
        rest = torch.stack([part.median(dim=-2).values for part in sides], dim=-2)
        noise = SIGMA_PER_MEDIAN * rest / math.sqrt(count)
    shares = torch.ones_like(ends)
    if weights is not None:
        sides = torch.stack([weights[..., 0], weights[..., -1]], dim=-1).mean(dim=-2)
        shares = shares * divided(sides, weights.amax(dim=(-2, -1))[:, None])[..., None]
    greatest = means.amax(dim=-2, keepdim=True)
    level = torch.minimum(greatest, MAX_LEVEL * means.mean(dim=-2, keepdim=True))
    return torch.cat([ends, nexts, shares, level, greatest, noise], dim=-2)


def ends_of(views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c m 2 10 i"]:
    """`edges_of` the columns of views, at their first and last row, and of their rows; zero where
    these have one pixel.
    """
    ends = []
    for lines in (views.mT, views):
        edges = edges_of(lines) * (lines.shape[-1] > 1)
        ends.append(pad(edges, (0, ROW_BLOCKS - edges.shape[-1])))
    return torch.stack(ends, dim=3)


def edge_shares(ends: Float[Tensor, "b c m 2 10 i"]) -> Float[Tensor, "b 2 2"]:
    """The edges of views beyond a standard deviation of noise relative to their greatest values, in
    the mean over all views: of the first and the last row, and of the first and the last column.
    """
    edges, _, _, level, _, noise = ends.mean(dim=2).split(PARTS, dim=-2)
    return divided((edges - noise).amax(dim=(1, 4)), level.amax(dim=(1, 4)))


def cut_sides(views: Float[Tensor, "b c m v u"]) -> Bool[Tensor, "b 2 2"]:
    """Whether views end inside the object, by `edge_shares`."""
    return edge_shares(ends_of(views)) > CUT_EDGE


def truncated_slices(views: Float[Tensor, "b c m v u"], cameras: Cameras) -> Bool[Tensor, " b"]:
    """Whether rays pass through parts of the object that other views do not show: views end inside
    it, at any side, or at the ends of rows that see a slice each, as those of parallel beams across
    their axis, which no ray leaves.
    """
    cut = cut_sides(views).any(dim=2)
    rows = cut[:, 0]
    if cameras.parallel:
        steps = torch.stack([cameras.u, cameras.origin - cameras.source])
        slices = ((unit(steps) @ unit(cameras.v[0])).abs() < MAX_SLICE_COSINE).all()
        rows = rows & ~slices.to(rows.device)  # without waiting for a GPU
    return rows | cut[:, 1]


def reach_rows(edges: Float[Tensor, "b c m 10 i"]) -> bool:
    """Whether an object reaches the first or the last row of any group of views: a mean over a
    block of their columns is above noise and above what air reads there, see `_air_along`.

    Args:
        edges: edges of the views' columns, `edges_of(views.mT)`.
    """
    edges = edges.flatten(0, 1)
    top = edges.split(PARTS, dim=-2)[3].amax(dim=(1, 2, 3))[:, None, None]
    ends, *_, noise = _grouped(edges).split(PARTS, dim=-2)
    noise = noise / math.sqrt(edges.shape[1] // len(noise))  # the least number of views in a group
    # an estimate from sixteen pixels is somewhere half the noise by chance
    noise = torch.maximum(noise, noise.movedim(1, 0).flatten(1).median(dim=1).values[:, None, None])
    air = _air_along(ends).clamp_min(0)
    most = air.amax(dim=3, keepdim=True)
    air = air * ((most < MAX_AIR) & (most < MAX_AIR_SHARE * top))
    return bool((ends - air > ROW_EDGE * top + ROW_DEVIATIONS * noise).any())


def _air_along(ends: Float[Tensor, "g k n i"]) -> Float[Tensor, "g k n i"]:
    """The reading of air along rows: of the straight lines below the means of all blocks, the one
    that is highest in the middle. The error of a flat field may differ between the panel's sides.
    """
    place = torch.arange(ends.shape[-1]).to(ends) - (ends.shape[-1] - 1) / 2
    rise = ends[..., :, None] - ends[..., None, :]
    slopes = divided(rise, place[:, None] - place).flatten(-2)  # one of them is zero
    middle = (ends[..., None, :] - slopes[..., None] * place).amin(dim=-1)
    height, best = middle.max(dim=-1, keepdim=True)
    return height + slopes.gather(-1, best) * place


def _grouped(x: Float[Tensor, "k m n i"]) -> Float[Tensor, "g k n i"]:
    """Means over groups of consecutive views."""
    parts = x.tensor_split(min(VIEW_GROUPS, x.shape[1]), dim=1)
    return torch.stack([part.mean(dim=1) for part in parts])


def truncated(edges: Float[Tensor, "b c k 10 i"]) -> Bool[Tensor, "b c k 1 1"]:
    """Whether views end inside the object, so that their rows are continued."""
    ends, _, shares, level, _, noise = edges.split(PARTS, dim=-2)
    cut = ((ends - noise) * shares).amax(dim=(-2, -1)) > CONTINUED_EDGE * level.amax(dim=(-2, -1))
    return cut[..., None, None]


def continuation(
    views: Float[Tensor, "*n u"], weights: Float[Tensor, "*#n u"], count: int
) -> tuple[Float[Tensor, "*n k"], Float[Tensor, "*n k"]]:
    """The columns before and behind each weighted row, in which the ellipses at its ends fall to
    zero within the row's length; the weight is that of the next column, of its own side or less.

    Args:
        views: line integrals.
        weights: weights of the views' pixels, which fall to zero where others measure the lines
            beyond.
        count: k, of columns on each side.
    """
    before = _behind(views.flip(-1), weights.flip(-1), count)
    return before.flip(-1), _behind(views, weights, count)


def _behind(
    views: Float[Tensor, "*n u"], weights: Float[Tensor, "*#n u"], count: int
) -> Float[Tensor, "*n k"]:
    """The columns behind the last one; places are in units of a row."""
    columns, known = views.shape[-1], torch.finfo(views.dtype)
    fitted = min(columns, max(MIN_FITTED, round(FITTED * columns)))
    scale = views[..., -fitted:].detach().abs().amax(dim=-1, keepdim=True).clamp_min(known.tiny)
    views = views / scale
    value, slope, curvature = _parabola(views[..., -fitted:].square(), columns)
    edge = views[..., -max(1, round(EDGE * columns)) :].mean(dim=-1, keepdim=True)
    # the gradients of quotients by smaller values overflow
    value = torch.maximum(value, edge.square() / 4).clamp_min(known.eps**2)
    slope = (slope / value).clamp_max(MAX_GROWTH)
    bend = torch.maximum(-curvature / value, 1 + slope).clamp_min(0)  # zero at a row's length
    apart = torch.arange(1, count + 1, device=views.device).to(views) / columns
    ratio = 1 + slope * apart - bend * apart.square()
    inside = ratio > 0
    last = weights[..., -1:]
    weight = torch.minimum(2 * last - weights[..., -2:][..., :1], last).clamp_min(0)
    return scale * edge * weight * torch.where(inside, ratio, 1).sqrt() * inside


def _parabola(
    values: Float[Tensor, "*n k"], columns: int
) -> tuple[Float[Tensor, "*n 1"], Float[Tensor, "*n 1"], Float[Tensor, "*n 1"]]:
    """The least-squares parabola of values at equal steps of 1 / columns: value and slope at the
    last one, and half the second derivative; by orthogonal polynomials, so that a GPU does not
    wait for a matrix.
    """
    count, end = values.shape[-1], (values.shape[-1] - 1) / (2 * columns)
    place = (torch.arange(count, device=values.device) - (count - 1) / 2).to(values) / columns
    square = (count**2 - 1) / (12 * columns**2)  # the mean of place^2
    fourth = (count**2 - 1) * (3 * count**2 - 7) / (240 * columns**4)
    least = 1e-30  # of fewer than three values
    mean = values.mean(dim=-1, keepdim=True)
    slope = (values * place).mean(dim=-1, keepdim=True) / max(square, least)
    bent = (values * (place.square() - square)).mean(dim=-1, keepdim=True)
    curvature = bent / max(fourth - square**2, least)
    value = mean + slope * end + curvature * (end**2 - square)
    return value, slope + 2 * curvature * end, curvature


def _flat_air(
    ends: Float[Tensor, "g k n i"], nexts: Float[Tensor, "g k n i"], top: Float[Tensor, "k 1 1"]
) -> Float[Tensor, "k n 1"]:
    """What a flat field that is off, or that drifts, may read at the edges of each side that show
    something: up to `MAX_AIR` and to `MAX_AIR_SHARE` of the greatest line integral, if these edges
    are as flat as air's, else zero.

    They are if they grow inwards by less than a half of what an ellipse of the greatest line
    integral does, whose squared line integrals are a parabola.

    Args:
        ends, nexts: the outermost columns and those beside them; NaN: they show nothing.
        top: the greatest line integral.
    """
    sides = (x.permute(1, 2, 0, 3).flatten(2) for x in (ends, nexts - ends))
    height, growth = (x.nanmedian(dim=2, keepdim=True).values for x in sides)
    inwards = 2 * (1 + BESIDE) * OUTERMOST  # twice the way in units of a half row
    ellipse = (height.square() + (top.square() - height.square()) * inwards).sqrt() - height
    return (growth < ellipse / 2) * (MAX_AIR_SHARE * top).clamp_max(MAX_AIR)


def warn_of_truncation(edges: Float[Tensor, "b c m 10 i"], extrapolate: bool) -> None:
    """Warn of views that end inside the object, whose jump at the edge the ramp filter takes for
    a part of the object, or whose continuation is a guess.

    An edge shows an object if it is above what air reads there, the lower quartile of all edges of
    its side if that is a small part of the greatest line integral, and above the noise of a group
    of views. Flat edges that a flat field may explain, see `_flat_air`, are named as either. Sides
    that other views measure better do not count.
    """
    edges = edges.flatten(0, 1)
    ends, nexts, shares, level, greatest, noise = edges.split(PARTS, dim=-2)
    used = (shares > 0.5).to(ends)
    seen = _grouped(used)
    ends, nexts = (divided(_grouped(x * used), seen, -math.inf) for x in (ends, nexts))
    most, top = (_grouped(x).amax(dim=(0, 3))[..., None] for x in (level, greatest))  # [k 1 1]
    known = torch.where(seen > 0, ends, torch.nan).permute(1, 2, 0, 3).flatten(2)
    lowest = known.nanquantile(AIR_QUANTILE, dim=2, keepdim=True).nan_to_num(0).clamp_min(0)
    air = lowest * (lowest < CUT_EDGE * top)
    noise = _grouped(noise) / math.sqrt(edges.shape[1] // len(seen))

    def beyond(air: Float[Tensor, "k n 1"]) -> Bool[Tensor, "g k n i"]:
        return ends - air > CUT_EDGE * most + MIN_DEVIATIONS * noise

    shown = beyond(air)
    edge, beside = (torch.where(shown, x, torch.nan) for x in (ends, nexts))
    flat = _flat_air(edge, beside, top)
    cut = beyond(torch.maximum(air, flat)).any(dim=2)
    either = not (cut.double().mean(dim=0) > WARNED_VIEWS).any()
    if either:
        cut = shown.any(dim=2)
    views = cut.double().mean(dim=0)
    worst = int(views.amax(dim=1).argmax())
    named = views[worst] > WARNED_VIEWS
    if not named.any():
        return
    height = ends.amax(dim=2)[:, worst][cut[:, worst]].mean().item()
    where, rows = f"{views[worst].max().item():.0%} of them", named.double().mean().item()
    where = where if rows == 1 else f"{where} and in {rows:.0%} of their rows"
    off = 1 - math.exp(-height)
    what = f"a wide, weak object, or their flat field is {off:.0%} off" if either else "the object"
    warnings.warn(
        f"Views end inside {what}: in {where} line integrals at a side of the detector are "
        f"above noise and what air reads, in the mean {(height / most[worst]).item():.0%} of the "
        f"greatest ones, or of {MAX_LEVEL:g} times their mean. "
        + (
            "Their rows are continued as those of ellipses: values inside the field of all views "
            "may be too high or too low by some per cent where the object is hollow or uneven at "
            "the edge, and those outside the field are a guess; "
            if extrapolate
            else "Filtered back-projection reads such objects high, most of all near the edge of "
            "the field; continue the rows (extrapolate=true), "
        )
        + "take a wider detector, or an iterative method such as sirt on a grid as large as the "
        "object",
        stacklevel=2,
    )
