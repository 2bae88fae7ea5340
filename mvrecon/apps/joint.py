"""Several measurements of one object in one likelihood: photopeaks, gated frames."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.apps.scan import Scan, ViewsInMemory
from mvrecon.core.files.checks import Refused
from mvrecon.data.attenuation import CONCENTRATION
from mvrecon.data.projections.views import MeasuredViews
from mvrecon.methods.calibration.frames import FrameShifts, frame_shifts
from mvrecon.operators.operator import LinearOperator, Scaled
from mvrecon.operators.stacked import joined_cameras


def joined(scans: Sequence[Scan]) -> Scan:
    """Scans of the same voxels as one: their views one after the other, in counts, so that one
    Poisson likelihood weights them; doses and factors are part of its operator.

    Raises:
        Refused: no counts; volumes of different units; views of different sizes; views in counts
            without the photons per decay, whose scales are not known to agree.
    """
    first = scans[0]
    for name, kinds in (
        ("counts of emission", {scan.counts for scan in scans} | {True}),
        ("volumes of one unit", {scan.unit for scan in scans}),
        ("views of one size", {scan.cameras.shape for scan in scans}),
    ):
        if len(kinds) > 1:
            raise Refused(
                f"expected joint measurements to be {name}, got {sorted(map(str, kinds))}"
            )
    for scan in scans:
        views = scan.measured
        if not isinstance(views, MeasuredViews):
            raise ValueError("Expected scans of views on disk, got views in memory")
        if scan.unit != CONCENTRATION and (views.stack.dose is None or views.stack.own_unit):
            raise Refused(
                f"{views.options.path}: expected factors.branching, the photons per decay, "
                f"or views of a known dose, for joint measurements, got neither"
            )
    wholes = [scan.measured.whole() for scan in scans]
    views, scatter, factors = [], [], []
    for scan, whole in zip(scans, wholes, strict=True):
        one = torch.ones_like(whole.views)
        views.append(scan.dose * whole.views)
        factors.append(scan.dose * (one if scan.factors is None else scan.factors))
        added = 0 * one[None, None] if scan.scatter is None else scan.scatter
        scatter.append(scan.dose * added)
    return replace(
        first,
        measured=ViewsInMemory(torch.cat(views), torch.cat([whole.mask for whole in wholes])),
        cameras=joined_cameras([scan.cameras for scan in scans]),
        scatter=torch.cat(scatter, dim=2) if any(s.scatter is not None for s in scans) else None,
        factors=torch.cat(factors),
        dose=1.0,
        rig=None,
        parts=tuple(scans),
    )


def with_shifts(scan: Scan, device: str) -> tuple[Scan, FrameShifts]:
    """A joint scan whose cameras follow the object, by how far it is shifted in each measurement;
    see `frame_shifts`.
    """
    whole = scan.measured.whole()
    mask = whole.mask.to(device)
    views = whole.views[None, None].to(device) * mask

    def operator_of(shifts: Float[Tensor, "g 3"]) -> LinearOperator:
        return Scaled(_moved(scan, shifts).operator().to(device), pixels=mask.to(views))

    counts = [len(part.cameras) for part in scan.parts]
    found = frame_shifts(operator_of, scan.grid, views, counts, background=scan.scatter)
    return _moved(scan, found.shift_mm), found


def _moved(scan: Scan, shifts: Float[Tensor, "g 3"]) -> Scan:
    """The scan in the frame of an object that is shifted by so much in each part."""
    still = torch.eye(3, dtype=torch.float64)
    moved = [
        replace(part, cameras=part.cameras.moved(still, -shift))
        for part, shift in zip(scan.parts, shifts, strict=True)
    ]
    cameras = joined_cameras([part.cameras for part in moved])
    return replace(scan, cameras=cameras, parts=tuple(moved))
