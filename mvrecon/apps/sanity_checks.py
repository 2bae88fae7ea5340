"""Sanity checks of a reconstruction that raised no error: NaN or infinite voxels, mirrored
views, exchanged axes, a wrong axis of rotation or range of angles, counts read as line integrals, a
volume that does not explain its views.
"""

import inspect
import math
import warnings
from contextlib import suppress

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.rig_checks import (
    SEARCH_ITERATIONS,
    SLICE_VOXELS,
    SomeViews,
    better_rig,
    coarse_grid,
    noise_of,
)
from mvrecon.apps.run_method import Method, Outcome
from mvrecon.apps.scan import ATTENUATION, Scan, ViewsInMemory, of_one_view
from mvrecon.core.parts import METHODS
from mvrecon.data.attenuation import WATER
from mvrecon.data.projections.views import MeasuredViews
from mvrecon.geometry.grid import coarse
from mvrecon.methods.calibration.self_alignment import share_beside
from mvrecon.methods.classical.fdk import fbp, fdk
from mvrecon.methods.classical.orbit import orbit_of
from mvrecon.methods.classical.sirt import sirt
from mvrecon.methods.method import Solver
from mvrecon.operators.operator import sees_integrals
from mvrecon.operators.stacked import joined_cameras
from mvrecon.report.metrics import nrmse

#: Attenuation relative to water's, above that of any matter at 60 keV, where lead has 300.
MAX_RELATIVE_ATTENUATION = 500.0
#: View NRMSE above which a volume does not reproduce its views.
MAX_VIEW_NRMSE = 0.25
#: View NRMSE above which a volume does not reproduce its views, by that of their noise.
MAX_NRMSE_TO_NOISE = 1.25
#: A method needs more views where it leaves at least this part of the residual of consistent ones,
#: and twice as much as of so many times as many.
MIN_SPARSE_SHARE, DENSER_FACTOR = 0.5, 4
#: Share of the line integrals whose rays miss the grid, from which on the grid is too small to
#: explain the views, and how many views it is measured in.
MIN_BESIDE, BESIDE_VIEWS = 0.1, 8
#: An iterative method has not converged where a coarse SIRT explains the views and leaves less than
#: this part of what it leaves.
MAX_CONVERGED_SHARE = 0.5
#: Quantile of an activity's voxels; a voxel of more than so many times its value fits noise.
ACTIVITY_QUANTILE, HOT_VOXEL_FACTOR = 0.999, 50.0
#: Line integral that no X-ray comes through: 2e-9 of it does.
OPAQUE_LINE_INTEGRAL = 20.0


def sanity_checks(
    scan: Scan,
    method: Method,
    outcome: Outcome,
    device: str = "cpu",
    as_read: MeasuredViews | ViewsInMemory | None = None,
) -> list[str]:
    """Return the failed checks of a scan's reconstruction, as sentences.

    A projector of weighted integrals, or without `pixel_integral`, is checked by the residual of
    its volume alone; a method declares its data, `declares`.

    Args:
        scan: the scan that was reconstructed.
        method: the method, with its options.
        outcome: what the method made, with a volume in the unit of the views per mm.
        device: device that computes the comparison.
        as_read: the views before a correction, which leaves no whole counts; None: the scan's.
    """
    words: list[str] = []
    limit, view_nrmse = MAX_VIEW_NRMSE, outcome.view_nrmse
    kind = getattr(METHODS.get(method.name), "data_kind", "integrals")
    lost = _of_lost_views(scan, outcome.lost)
    if bad := int((~outcome.volume.isfinite()).sum()):  # no limit below is exceeded by NaN
        words.append(
            f"{bad} of the volume's {outcome.volume.numel()} voxels are NaN or infinite: "
            f"{method.name} has diverged, or divides by zero"
        )
    seen = SomeViews.of(scan, coarse_grid(scan), device) if _sees_integrals(scan) else None
    if seen:
        counts = _of_counts(seen.first) if kind == "integrals" else []
        words += counts
        times = outcome.volume.max().item() / WATER
        if (
            kind == "integrals"
            and scan.unit == ATTENUATION
            and times > MAX_RELATIVE_ATTENUATION
            and not words
        ):
            words.append(
                f"the volume reaches {times:.0f} times the attenuation of water: expected "
                f"lengths in mm, are the rig's and the grid's in metres?"
            )
        if not counts and (better := better_rig(seen)):
            words.append(better)
    elif kind == "counts":
        noise = _noise_of_counts((as_read or scan.measured).read(0, 1).views)
        limit = max(MAX_VIEW_NRMSE, MAX_NRMSE_TO_NOISE * (noise or 0))
        if noise is None and view_nrmse > MAX_VIEW_NRMSE:
            words.append(
                f"expected counts, got numbers that are not whole, which the volume does not "
                f"explain (view NRMSE {view_nrmse:.2g}); projector=drr is for line integrals"
            )
        elif noise is not None:
            words += _of_hot_voxels(outcome.volume)
    # the views of a right volume differ from lost ones, which are zero, by their whole norm
    limit = math.hypot(limit, math.sqrt(len(outcome.lost) / len(scan.cameras)))
    beside = _beside(seen) if seen and view_nrmse > limit else 0.0
    # filtered back-projection is right on a grid of a part of the object, which explains no views
    part = beside > MIN_BESIDE and METHODS.get(method.name) in (fbp, fdk)
    if view_nrmse > limit and not words and not part:
        cause = _cause(seen, method, view_nrmse, beside) if seen and kind != "counts" else ""
        words.append(
            f"re-projecting the volume does not reproduce the views (view NRMSE {view_nrmse:.2g}); "
            + (
                cause
                or "look at rig.png, and whether lengths are mm, the views whole, the grid "
                "large enough, and a network was trained for such views"
            )
        )
    return lost + words


def _sees_integrals(scan: Scan) -> bool:
    """Whether the projector takes plain line integrals."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the operator of the reconstruction gives these warnings
        return sees_integrals(of_one_view(scan))


def _beside(seen: SomeViews) -> float:
    """The share of the line integrals in pixels whose rays miss the scan's grid, in the mean over
    some views: a long object may extend beyond it in one and not in another.
    """
    scan, total = seen.scan, 0.0
    numbers = seen.numbers[:: math.ceil(len(seen.numbers) / BESIDE_VIEWS)]
    for number in numbers.tolist():
        cameras, views = scan.cameras[number : number + 1], scan.measured.read(number, number + 1)
        A = scan.on(scan.grid, cameras)
        total += share_beside(A, (views.views * views.mask)[None, None]).item()
    return total / len(numbers)


def _cause(seen: SomeViews, method: Method, view_nrmse: float, beside: float) -> str:
    """Why a volume does not explain line integrals, where that is not the rig: their noise, an
    object that extends beyond the grid, a method that has not converged, or one that needs more
    views; else empty.

    A method needs more views where its volume explains neither these views nor, on a coarse grid,
    those of a known volume by the same rig, but those of four times as many cameras on its orbit.
    """
    scan, view, device = seen.scan, seen.first, str(seen.views.device)
    level, size = (x.double().square().mean().sqrt().item() for x in (noise_of(view), view))
    noise = level / size if size else 0.0
    if view_nrmse < MAX_NRMSE_TO_NOISE * noise:
        return (
            f"their noise alone is about {noise:.2g} of them, by the second differences of pixels"
        )
    if beside > MIN_BESIDE:
        return (
            f"{beside:.0%} of the line integrals are those of rays outside the grid, which no "
            f"volume on it explains: is it as large as the object?"
        )
    module = method.module
    if not isinstance(module, Solver):
        return ""
    with suppress(ValueError), torch.no_grad(), warnings.catch_warnings():  # not on a circle
        warnings.simplefilter("ignore")  # the method has given its own
        grid = coarse(scan.grid, SLICE_VOXELS)
        seen = SomeViews.of(scan, grid, device)
        A = scan.on(grid, seen.cameras).to(device)
        x = sirt(A, seen.views, SEARCH_ITERATIONS, momentum=True)
        left = nrmse(A(x), seen.views)
        if "iterations" in inspect.signature(module.solve).parameters and (
            left < min(MAX_VIEW_NRMSE, MAX_CONVERGED_SHARE * view_nrmse)
        ):
            return (
                f"{SEARCH_ITERATIONS} iterations of sirt with momentum on a coarse grid leave only "
                f"{left:.2g} of them: has {method.name} converged (method.iterations)?"
            )
        orbit = orbit_of(A.cameras, A.grid)
        step = (torch.remainder(orbit.angles.diff() + 180, 360) - 180).mean()
        turns = (step.expand(len(A.cameras)) * k / DENSER_FACTOR for k in range(DENSER_FACTOR))
        rig = joined_cameras([orbit.turned(A.cameras, turn) for turn in turns])
        rig = rig[torch.arange(len(rig)).view(DENSER_FACTOR, -1).T.flatten()]  # in their order
        few, many = (nrmse(B(module(B(x), B).volume), B(x)) for B in (A, scan.on(A.grid, rig)))
        if few > max(MIN_SPARSE_SHARE * view_nrmse, 2 * many):
            return (
                f"{method.name} of {len(scan.cameras)} views leaves {few:.2g} of views that fit "
                f"this rig, and {many:.2g} of {DENSER_FACTOR} times as many: these are too few for "
                f"it, and an iterative method such as sirt explains them better"
            )
    return ""


def _of_counts(view: Float[Tensor, "1 v u"]) -> list[str]:
    """Check for a view whose values are whole numbers too large for line integrals."""
    if view.max() <= OPAQUE_LINE_INTEGRAL or not _whole(view):
        return []
    return [
        f"expected line integrals, got whole numbers up to {view.max().item():g}; grey values want "
        f"views.kind=intensities and views.flat, counts of emission osem"
    ]


def _of_lost_views(scan: Scan, numbers: list[int]) -> list[str]:
    """Check for views that are zero everywhere, as columns of a sinogram beside the object are, or
    slices above and below it.
    """
    if not numbers:
        return []
    measured, count = scan.measured, len(scan.cameras)
    sinogram = isinstance(measured, MeasuredViews) and measured.options.layout == "sinogram"
    remedies = []
    if numbers[0] == 0 and numbers[-1] == count - 1:
        remedies += [
            "are the sinogram's angles its columns? Expected its rows"
            if sinogram
            else "are they slices of a sinogram (views.layout=sinogram)?"
        ]
    if len(numbers) <= count // 2:
        remedies += ["correct=align replaces them by the volume's"]
    found = f"lost views, zero everywhere: {', '.join(map(str, numbers))} (from 0)"
    return ["; ".join([found, *remedies])]


def _of_hot_voxels(volume: Float[Tensor, "d h w"]) -> list[str]:
    """Check for voxels that are far above almost all others."""
    values = volume.flatten().sort().values
    high, most = values[int(ACTIVITY_QUANTILE * (len(values) - 1))].item(), values[-1].item()
    if not 0 < HOT_VOXEL_FACTOR * high < most:
        return []
    return [
        f"single voxels reach {most / high:.0f} times the {100 * ACTIVITY_QUANTILE:g}th "
        f"percentile: unless the object is a point, the volume fits the noise of the counts; use "
        f"fewer iterations (method.iterations), or bsrem, which has a prior"
    ]


def _noise_of_counts(view: Float[Tensor, "1 v u"]) -> float | None:
    """NRMSE of a view's Poisson noise, where it holds counts, or counts times a factor, the least
    value above zero, as simulated views of an activity of one do; none where it holds no counts.
    """
    if not (view > 0).any():
        return 0.0
    counts = view.double() / (1 if _whole(view) else view[view > 0].min())
    if not torch.allclose(counts, counts.round(), rtol=1e-4, atol=0):
        return None
    return (counts.sum().sqrt() / counts.norm()).item()


def _whole(view: Float[Tensor, "1 v u"]) -> bool:
    """Whether all values are whole numbers."""
    return view.equal(view.round())
