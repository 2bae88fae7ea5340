"""Steps between the views of an orbit: which gaps are usual where, and which views are exposures of
one direction.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.geometry.cameras.field import ROUNDING_ERROR, SAME_ANGLE
from mvrecon.methods.classical.orbit import Orbit

FULL_TURN = 2 * math.pi

#: A gap between views ends a branch if it is wider than so many usual steps and than the first
#: angle, or than the second one.
GAP_STEPS, MIN_GAP, MAX_STEP_ANGLE = 5.0, math.radians(2.0), math.radians(125.0)
#: The usual step is the least one such that steps up to it make up this part of the measured arc,
#: or one that is wider by this factor where so many gaps as wide follow one another.
USUAL_STEP_SHARE, WIDER, ROW_STEPS = 0.3, 2.5, 3
#: Views that span less than this part of a step count as one, as several exposures are.
SPAN_SHARE = 0.45
#: Steps within this ratio are alike.
SAME_STEP = 1.05
#: Views closer than this part of the usual step are exposures at one angle, and share its cell.
EXPOSURE_STEP_SHARE = 0.2
#: A direction in which a scan has no view, and that no symmetry of one keeps.
ASIDE = (0.81, 0.47, 0.35)


def start_of(orbit: Orbit) -> float:
    """The angle behind the widest gap, in radians from the first view; of several as wide the first
    one after a fixed direction, so that results do not depend on the order of the views.
    """
    aside = orbit.axis.new_tensor(ASIDE)
    zero = torch.atan2(orbit.tangents[0] @ aside, orbit.outwards[0] @ aside)
    angles = (torch.deg2rad(orbit.angles) - zero).remainder(FULL_TURN).sort().values
    gaps = gaps_of(angles)
    widest = int((gaps > gaps.max() - ROUNDING_ERROR).int().argmax())
    return (zero + angles[(widest + 1) % len(angles)]).item()


def gaps_of(angles: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """The gap behind each of sorted angles, around the circle."""
    return torch.cat([angles[1:], angles[:1] + FULL_TURN]) - angles


def usual_steps(gaps: Float[Tensor, " m"]) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """The usual step about each view, and that of as many views, spread evenly: smaller than the
    usual one where views are clustered.

    It is the least one such that steps up to it make up a part of the measured arc, which repeated
    views do not change, or a wider one in a row of several gaps that are as wide: lost views make
    no such row.

    Args:
        gaps: the gap behind each view, around the circle.
    """
    count, step = len(gaps), gaps <= MAX_STEP_ANGLE
    steps = gaps[step & (gaps > 0)].sort().values
    if not len(steps):
        return (torch.full_like(gaps, MAX_STEP_ANGLE),) * 2
    usual = steps[
        torch.searchsorted(steps.cumsum(0), USUAL_STEP_SHARE * steps.sum(dim=0, keepdim=True))
    ]
    even = steps[steps > SAME_ANGLE].mean().nan_to_num(MAX_STEP_ANGLE)
    steps = steps[steps > WIDER * usual]
    alike = (steps.log() / math.log(SAME_STEP)).round()
    widths = torch.cat([usual, steps[alike.diff(prepend=alike[:1] - 1) > 0]])[:, None]
    gaps, step = gaps.repeat(3), step.repeat(3)
    wide = gaps >= widths * (1 - ROUNDING_ERROR)
    ends = ~step | (_between(wide, gaps) > SPAN_SHARE * widths)
    number, length, views = (_between(ends, x) for x in (wide, gaps, gaps > SAME_ANGLE))
    width, row = torch.where(~ends & (number >= ROW_STEPS), widths, 0).max(dim=0, keepdim=True)
    even = torch.where(width > 0, (length / views).gather(0, row), even)[0]
    usual = torch.maximum(width, usual)[0]
    # of the wider one of the gaps before and behind each view
    before, behind = slice(count - 1, 2 * count - 1), slice(count, 2 * count)
    wider = usual[behind] >= usual[before]
    usual, even = (torch.where(wider, x[behind], x[before]) for x in (usual, even))
    return usual, even


def _between(ends: Bool[Tensor, "n m"], values: Tensor) -> Float[Tensor, "n m"]:
    """The sum of values between the ends before and behind each place, 0 or less at an end."""
    count = ends.shape[-1]
    index, values = torch.arange(count), values.double().expand(ends.shape)
    upto = torch.nn.functional.pad(values.cumsum(dim=-1), (1, 0))
    before = torch.where(ends, index, -1).cummax(dim=-1).values
    behind = torch.where(ends, index, count).flip(-1).cummin(dim=-1).values.flip(-1)
    return upto.gather(-1, behind) - upto.gather(-1, before + 1)


def widest_of(usual: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The widest gap between views that does not end a branch, by their usual step."""
    return (GAP_STEPS * usual).clamp(MIN_GAP, MAX_STEP_ANGLE)


def of_exposures(
    cells: Float[Tensor, "*n m"], angles: Float[Tensor, " m"]
) -> Float[Tensor, "*n m"]:
    """The mean of the cells of the views at each of sorted angles, several exposures or panels."""
    gaps = gaps_of(angles)
    usual, _ = usual_steps(gaps)
    usual = torch.minimum(usual, usual.roll(-1))
    apart = gaps > EXPOSURE_STEP_SHARE * usual - ROUNDING_ERROR
    begins = (apart | (_between(apart, gaps) > SPAN_SHARE * usual)).roll(1)
    if begins.all() or not begins.any():
        return cells
    number = (begins.cumsum(0) - 1).remainder(int(begins.sum()))  # the first may continue the last
    sums = cells.new_zeros(*cells.shape[:-1], int(begins.sum())).index_add(-1, number, cells)
    return (sums / number.bincount())[..., number]
