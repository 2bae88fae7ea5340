"""Pixels that measure wrongly: dead, hot and stuck ones, found in flat and dark fields and in the
views, and zingers, bright in single views; and the values that fill them.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, shown
from mvrecon.core.numbers import SIGMA_PER_MEDIAN, second_differences

#: Share of its neighbours' value by which a pixel of the fields, or of the views, lies outside.
MIN_OFF_IN_FIELDS, MIN_OFF_IN_VIEWS = 0.5, 0.1
#: Part of the contrast that a pixel reads above its neighbours without a beam.
MIN_HOT = 0.1
#: Standard deviations of noise beyond which a pixel of fields, of views and a zinger lie outside.
FIELD_SIGMAS, VIEW_SIGMAS, ZINGER_SIGMAS = 10, 5, 10
#: Transmission that a zinger adds at least; below, noise is that of reading, not Poisson's.
LEAST_LIGHT = 0.02
#: Share of the views in which a wrong pixel lies outside; part of its neighbours' variation that
#: one varies by at most if it is stuck; share of its pixels that are stuck in a row.
MIN_VIEWS, MAX_STUCK, MIN_ROW = 1 / 3, 0.1, 0.5
#: Widest gap between the modules of a detector whose pixels have one value in all views; darker
#: ones may be metal on the axis of rotation.
MAX_GAP = 16
#: Transmission below which noise does not fall.
LEAST_NOISE = 1e-4
#: Attenuation below which a row that does not respond is a gap of the object.
MAX_AIR = 0.02
#: Views that tell wrong pixels: at least, and at most; pixels of these at a time.
FEWEST_VIEWS, SAMPLED_VIEWS, SAMPLED_PIXELS = 16, 32, 2**20
#: Steps down and right to the pixels next to one.
BESIDE = torch.tensor([[0, 0, -1, 1], [-1, 1, 0, 0]])
#: Columns named, of each kind, before the rest is counted.
NAMED = 8


class Fields(NamedTuple):
    """Dark field D and contrast F - D in grey values, and the pixels that are not dead; the
    contrast of dead ones is 1.
    """

    dark: Float[Tensor, "v u"]
    contrast: Float[Tensor, "v u"]
    alive: Bool[Tensor, "v u"]


def fields(
    dark: Float[Tensor, "v u"],
    flat: Float[Tensor, "v u"],
    where: str,
    dead: float = 0.0,
    saturation: float = math.inf,
) -> Fields:
    """Dark field and contrast of a detector in grey values, and the pixels without a fault.

    Args:
        dark: grey values without a beam.
        flat: grey values without an object.
        where: source of the fields, for messages.
        dead: pixels whose contrast is at most this part of its median are dead. Those whose
            contrast is less than half or more than one and a half times their neighbours', or that
            read a tenth of the contrast more than them without a beam, are wrong as well, beyond
            ten standard deviations.
        saturation: grey value; pixels that reach it in the flat field are also dead.

    Raises:
        Refused: a flat field not above the dark one, or fewer than half of the pixels left.
    """
    contrast = flat - dark
    middle = contrast.median().item()
    if not middle > 0:
        raise Refused(
            f"{where}: expected a flat field above the dark one, got the medians "
            f"{flat.median().item():g} and {dark.median().item():g} (zero or swapped?)"
        )
    alive = (contrast > max(0.0, dead * middle)) & (flat < saturation)
    if 2 * int(alive.sum()) < alive.numel():
        raise Refused(
            f"{where}: expected at least half of the pixels between dark and saturated, got "
            f"{int(alive.sum())} of {alive.numel()}; flat field's largest grey value "
            f"{flat.max().item():g}, saturation {saturation:g} (views.saturation states another)"
        )
    level = contrast.clamp(min=1e-6 * middle).log()
    for off, least in (
        ((level - _median_of_neighbours(level)).abs(), math.log1p(MIN_OFF_IN_FIELDS)),
        (dark - _median_of_neighbours(dark), MIN_HOT * middle),
    ):
        sigma = SIGMA_PER_MEDIAN * off[alive].abs().median().item()
        alive = alive & (off <= max(least, FIELD_SIGMAS * sigma))
    return Fields(dark, torch.where(alive, contrast, 1.0), alive)


def _median_of_neighbours(values: Float[Tensor, "v u"]) -> Float[Tensor, "v u"]:
    """Medians of seven pixels along rows, then columns: steps stay where they are."""
    return _median_along(_median_along(values).mT).mT


def _median_along(values: Float[Tensor, "r n"], reach: int = 3) -> Float[Tensor, "r n"]:
    """Medians along the last axis, of so many pixels on both sides."""
    padded = F.pad(values[None], (reach, reach), mode="replicate")[0]
    return padded.unfold(1, 2 * reach + 1, 1).median(dim=-1).values


def wrong_in_views(light: Float[Tensor, "m v u"]) -> Bool[Tensor, "v u"]:
    """Pixels that differ from their neighbours in at least a third of the views, and rows that do
    not respond.

    A pixel differs if it leaves the range of what the two pixels to its left and to its right tell
    of it (their means, and their lines continued) by 10 %, five standard deviations of their noise,
    and that range: slopes and steps, such as edges of a static table, do not differ, nor do
    profiles that the detector blurs, and what moves with the object passes by. One that does not
    vary with the views is stuck; it may be one of two next to each other, so is compared with
    pixels two and three columns away, and one of up to 16 that have one value in all views with
    those beside them. A wrong row is one of stuck pixels, as thin layers of the
    object lie in one row of all views, too.

    Args:
        light: transmissions of views over the whole scan.
    """
    step = max(1, SAMPLED_PIXELS // (len(light) * light.shape[2]))
    parts = [_outside(part) for part in light.split(step, dim=1)]
    wrong, stuck = (torch.cat(found) for found in zip(*parts, strict=True))
    every = light[..., :: max(1, light.shape[2] // 128)]
    _, rows = _outside(every.mT.contiguous())
    air = (every.mean(dim=(0, 2)) - 1).abs() < MAX_AIR
    return wrong | stuck | ((rows.float().mean(dim=0) >= MIN_ROW) & ~air)[:, None]


def _outside(light: Float[Tensor, "m r n"]) -> tuple[Bool[Tensor, "r n"], Bool[Tensor, "r n"]]:
    """Pixels outside of the range of their neighbours along n, and those that are stuck; both ends
    have no neighbours on one side, and are neither.
    """
    count = light.shape[-1]
    padded = F.pad(light, (3, 3), mode="replicate")

    def at(places: Sequence[int], values: Tensor = padded) -> list[Tensor]:
        return [values[..., 3 + k : 3 + k + count] for k in places]

    left, right = at((-1, 1))
    between = (left + right) / 2
    rest = second_differences(padded[..., 2:-2]).abs()
    rest /= between.clamp(min=LEAST_NOISE).sqrt()  # in relation to Poisson's
    noise = SIGMA_PER_MEDIAN * rest.median(dim=0).values
    lit = noise[between.mean(dim=0) > LEAST_LIGHT]
    poisson = lit.median().item() if len(lit) else 0.0
    noise = _median_along(noise, 8).clamp(min=poisson)  # none where hardly a photon arrives
    level = light.mean(dim=0) / between.mean(dim=0).clamp(min=1e-6)
    uneven = SIGMA_PER_MEDIAN * (level - level.median()).abs().median().item()
    least = max(MIN_OFF_IN_VIEWS, VIEW_SIGMAS * uneven)

    def share(near: Sequence[Tensor], spread: float) -> Tensor:
        low, high = near[0], near[0]
        for one in near[1:]:
            low, high = torch.minimum(low, one), torch.maximum(high, one)
        sigma = noise * high.clamp(min=max(LEAST_NOISE, poisson**2)).sqrt()
        margin = VIEW_SIGMAS * sigma + spread * (high - low)
        above = light > high + least * high.abs() + margin
        off = above | (light < low - least * low.abs() - margin)
        return off.float().mean(dim=0)

    changes = (light - light.mean(dim=0)).abs().mean(dim=0)
    near = at((-3, -2, 2, 3), F.pad(changes[None], (3, 3), mode="replicate")[0])
    others = torch.stack(near).median(dim=0).values
    still = (changes <= MAX_STUCK * others) & (others > 0)
    stuck = still & (share(at((-3, -2, 2, 3)), 0.0) >= MIN_VIEWS)
    constant = light.amin(dim=0) == light.amax(dim=0)
    places = torch.arange(count).expand_as(constant)
    last = torch.where(constant, -1, places).cummax(dim=-1).values
    following = torch.where(constant, count, places).flip(-1).cummin(dim=-1).values.flip(-1)
    gap = constant & (last > 0) & (following < count - 1) & (following - last <= MAX_GAP + 1)
    if (gap := gap & (light[0] > LEAST_LIGHT)).any():
        beside = [
            light.gather(-1, k.clamp(0, count - 1).expand_as(light))
            for k in (last - 1, last, following, following + 1)
        ]
        stuck = stuck | gap & (share(beside, 0.0) >= MIN_VIEWS)
    before, after = at((-2, 2))
    expected = [between, (before + after) / 2, 2 * left - before, 2 * right - after]
    return share(expected, 1.0) >= MIN_VIEWS, stuck


def zingers(images: Float[Tensor, "n i j"]) -> Bool[Tensor, "n i j"]:
    """Single bright pixels, as of X-rays that hit the camera: above all eight neighbours by 10 %
    and ten standard deviations of the noise around them. Of several next to each other, each is
    found once brighter ones are filled. Edges, lines and corners have neighbours that are as
    bright.

    Args:
        images: transmissions; of views with one or two rows, sinograms [v m u].
    """
    found = torch.zeros_like(images, dtype=torch.bool)
    if min(images.shape[1:]) < 5:
        return found
    for image, here in zip(images, found, strict=True):
        while len((places := _peaks(image))[0]):  # none of which is filled already
            here[places] = True
            image = filled(image[None], here)[0]
    return found


def _peaks(image: Float[Tensor, "i j"]) -> tuple[Tensor, Tensor]:
    """Rows and columns of pixels above all eight neighbours, beyond noise."""
    height, width = image.shape
    rise = 1 + MIN_OFF_IN_VIEWS
    beside = torch.maximum(image[:, :-2], image[:, 2:])
    above = image[:, 1:-1] > beside.clamp_(min=0).mul_(rise)  # of light below the dark field, too
    flat = torch.from_numpy(np.flatnonzero(above.numpy()))  # which is fast where few are above
    i, j = flat // (width - 2), flat % (width - 2) + 1
    if not len(flat):
        return i, j
    few = image[:: max(1, height // 64)]  # tell the noise in relation to Poisson's
    level = (few[:, :-2] + few[:, 2:]) / 2
    ratio = second_differences(few).abs() / level.clamp(min=LEAST_LIGHT).sqrt()
    bright = ratio[level > LEAST_LIGHT]  # in others hardly a photon arrives
    poisson = SIGMA_PER_MEDIAN * (bright if len(bright) else ratio).median()
    reach = torch.arange(-2, 3)
    rows, columns = (
        size - 1 - (size - 1 - (index[:, None] + reach).abs()).abs()  # mirrored at the edges
        for index, size in ((i, height), (j, width))
    )
    around = image[rows[:, :, None], columns[:, None, :]]
    ring = around[:, 1:4, 1:4].flatten(1)[:, [0, 1, 2, 3, 5, 6, 7, 8]].amax(dim=1).clamp(min=0)
    rest = second_differences(around)[:, [0, 1, 3, 4]].flatten(1).abs()  # without its own row
    sigma = SIGMA_PER_MEDIAN * rest.median(dim=1).values
    sigma = torch.maximum(sigma, poisson * ring.clamp(min=LEAST_LIGHT).sqrt())
    peak = image[i, j] > rise * ring + (ZINGER_SIGMAS * sigma).clamp(min=LEAST_LIGHT)
    return i[peak], j[peak]


def transmissions(integrals: Float[Tensor, "m v u"]) -> Float[Tensor, "m v u"]:
    """Transmissions of line integrals, finite also of pixels far below zero."""
    return (-integrals).clamp(max=10).exp()


def filled(values: Float[Tensor, "m v u"], wrong: Bool[Tensor, "v u"]) -> Float[Tensor, "m v u"]:
    """Fill wrong pixels with the mean of right ones beside, above and below them, clusters from
    their edges inwards.
    """
    values, wrong = values.clone(), F.pad(wrong, (1, 1, 1, 1), value=True)
    while (edge := _beside_right(wrong)).any():
        v, u = edge.nonzero(as_tuple=True)
        rows, columns = v[:, None] + BESIDE[0], u[:, None] + BESIDE[1]
        weights = (~wrong[rows, columns]).to(values)
        rows = (rows - 1).clamp(0, values.shape[1] - 1)
        columns = (columns - 1).clamp(0, values.shape[2] - 1)
        means = (values[:, rows, columns] * weights).sum(dim=-1) / weights.sum(dim=-1)
        values[:, v - 1, u - 1] = means
        wrong[v, u] = False
    return values


def _beside_right(wrong: Bool[Tensor, "i j"]) -> Bool[Tensor, "i j"]:
    """Wrong pixels with a right one beside, above or below, within a frame of one pixel."""
    inside, edge = wrong[1:-1, 1:-1], torch.zeros_like(wrong)
    all_wrong = wrong[:-2, 1:-1] & wrong[2:, 1:-1] & wrong[1:-1, :-2] & wrong[1:-1, 2:]
    edge[1:-1, 1:-1] = inside & ~all_wrong
    return edge


def read_mask(path: str | Path, shape: tuple[int, int], values: np.ndarray) -> Bool[Tensor, "v u"]:
    """A mask of bad pixels from an image's values: 0 good, one other value bad.

    Raises:
        Refused: another size than of the views, or other values.
    """
    if values.shape != shape:
        raise Refused(
            f"{path}: expected a mask of the views' {shape} pixels (rows, columns), got "
            f"{values.shape}"
        )
    kinds = np.unique(values)
    if len(kinds) > 2 or not (kinds == 0).any():
        raise Refused(f"{path}: expected a mask with 0 (good) and 1 (bad), got {shown(kinds)}")
    return torch.from_numpy(values != 0)


def in_words(wrong: Bool[Tensor, "v u"], rows: Sequence[int], columns: Sequence[int]) -> str:
    """Where wrong pixels are: columns and rows of which at least half is wrong, and how many
    others; `rows` and `columns` are the pixels' numbers on disk.
    """
    parts, rest = [], wrong.clone()
    for name, numbers, axis in (("column", columns, 0), ("row", rows, 1)):
        whole = 2 * rest.sum(dim=axis) >= max(rest.shape[axis], 1)
        if axis == 1 and len(columns) == 1 or not whole.any():
            continue
        found = [numbers[k] for k in whole.nonzero().flatten().tolist()]
        more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
        listed = ", ".join(map(str, sorted(found)[:NAMED]))
        parts.append(f"{name}{'s' if len(found) > 1 else ''} {listed}{more}")
        rest = rest & ~(whole[None] if axis == 0 else whole[:, None])
    if single := int(rest.sum()):
        parts.append(f"{single} other pixels" if single > 1 else "one other pixel")
    return ", ".join(parts)
