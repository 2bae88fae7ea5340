"""Shifts and gains of wrong cameras from the measured views alone, by turns with the volume.

The views are reconstructed, aligned with the views of the volume, reconstructed again (alignment by
re-projection: Dengler, Ultramicroscopy 30, 1989). What all cameras would share - the motion of the
object, its scale - is chosen such that most cameras stand still: least absolute deviations, which
a few wrong cameras do not move (Bloomfield & Steiger, Least Absolute Deviations, 1983).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.core.parts import CORRECTIONS
from mvrecon.kernels.device_cache import device_cached, grid_key
from mvrecon.methods.calibration.alignment import CorrectedViews, aligned, alignment
from mvrecon.methods.calibration.from_data import motions
from mvrecon.methods.classical.sirt import sirt, sirt_weights
from mvrecon.methods.learned.start import fingerprints
from mvrecon.methods.method import build_method
from mvrecon.methods.reconstruction import Alignment, Reconstruction
from mvrecon.operators.checks import check_finite, check_views
from mvrecon.operators.operator import Projector

#: Shifts in pixels, and gains, below which a camera counts as standing still.
STILL_PX, STILL_GAIN = 0.03, 0.003
#: Of the sum of what modes move: modes that move less are shared by no cameras.
NOT_SHARED = 1e-10
#: Least squares, reweighted, for the least absolute deviations.
REWEIGHTED = 10


@torch.no_grad()
def self_aligned(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    alternations: int = 4,
    iterations: int = 8,
) -> CorrectedViews:
    """Views as cameras without shift (pixels) and wrong gain would have measured them, both told by
    the views alone.

    Args:
        A: the operator of the cameras as they should be; its grid must hold the whole object.
        views: measured integrals.
        alternations: of reconstruction and alignment.
        iterations: of SIRT with momentum in each, from the volume of the one before.

    Raises:
        ValueError: as `self_alignment`.
    """
    by = self_alignment(A, views, alternations, iterations)
    return CorrectedViews(aligned(views, by), by)


@torch.no_grad()
def self_alignment(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    alternations: int = 4,
    iterations: int = 8,
) -> Alignment:
    """Shift in pixels and gain of every camera, from its view and those of the others.

    Args:
        A: the operator of the cameras as they should be; its grid must hold the whole object.
        views: measured integrals.
        alternations: of reconstruction and alignment.
        iterations: of SIRT with momentum in each, from the volume of the one before.

    Raises:
        ValueError: views that are not finite (on a GPU, where nobody waits for them, the volume of
            such views is not finite either), or no alternation.
    """
    if alternations < 1:
        raise ValueError(f"expected at least one alternation, got {alternations}")
    check_finite(views, on_gpu=False)
    by, volume, weights = Alignment.none(views), None, sirt_weights(A, views.dtype)
    cameras, centre = A.cameras, A.grid.centre
    moves = device_cached(
        cameras,
        ("motions", grid_key(A.grid)),
        views,
        lambda: motions(cameras, centre).detach().to(views.device),
    )
    for _ in range(alternations):
        volume = sirt(
            A, aligned(views, by), iterations, weights=weights, momentum=True, start=volume
        )
        fitted = alignment(views, A(volume), start=by, steps=1)
        by = standing_still(fitted, moves)
    return by


def standing_still(by: Alignment, moves: Float[Tensor, "m 2 3"]) -> Alignment:
    """The alignment, its shifts (pixels) less a motion of the object and its gains over a common
    factor, such that most cameras have no error.

    Without it an object that wrong cameras have drawn aside is taken for the right one.

    Args:
        by: the alignment.
        moves: what a motion of the object is in the views, by `motions`.
    """
    shift = least_deviations(by.shift_px, moves.to(by.shift_px.device), STILL_PX)
    common = by.gain.new_ones(by.gain.shape[1], 1, 1)
    gain = least_deviations(by.gain.log()[..., None], common, STILL_GAIN)
    return replace(by, shift_px=shift, gain=gain[..., 0].exp())


def least_deviations(
    values: Float[Tensor, "b m k"], modes: Float[Tensor, "m k q"], floor: float
) -> Float[Tensor, "b m k"]:
    """Values of cameras less the combination of modes that leaves the least sum of their lengths,
    in the values' unit.

    Args:
        values: of each camera.
        modes: what all cameras may share.
        floor: lengths below count as zero.
    """
    dtype, values, modes = values.dtype, values.double(), modes.double()
    rest, flat = values, modes.flatten(0, 1)
    unit = torch.eye(modes.shape[2], dtype=values.dtype, device=values.device)
    for _ in range(REWEIGHTED):
        weight = (rest.square().sum(dim=-1, keepdim=True) + floor**2).rsqrt()
        weighted = (modes * weight[..., None]).flatten(1, 2).mT
        slope = weighted @ values.flatten(1)[..., None]
        normal = weighted @ flat
        total = normal.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
        # so little that only modes that move nothing feel it; a pseudo-inverse would be waited for
        damping = (NOT_SHARED * total + torch.finfo(values.dtype).eps) * unit
        shared = flat @ torch.linalg.inv_ex(normal + damping)[0] @ slope
        rest = values - shared.view_as(values)
    return rest.to(dtype)


class Aligned(nn.Module):
    """Reconstruction by another method from aligned views, in the unit of (views / mm).

    The alignment is not differentiated. In training it is computed once for each case, at its first
    occurrence; the views of every step are read on the host for this.

    Args:
        method: name and options of the method.
        correct: name and options of the correction.

    Raises:
        LookupError: an unknown name.
        TypeError: an option that a part does not have.
    """

    def __init__(self, method: Mapping[str, Any], correct: Mapping[str, Any] | None = None):
        super().__init__()
        self.method = build_method(method)
        self.correct = dict(correct or {"name": "align"})
        CORRECTIONS.check(self.correct)
        self._known: dict[bytes, Alignment] = {}

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        # an alignment to parts of a pixel needs float32
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views, A) if self.training else self._corrected(views, A)
        return replace(self.method(corrected.views, A), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        return CORRECTIONS.from_config(self.correct, A, views)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        """The corrected views, by their alignments where these are known."""
        names = fingerprints(views)
        new = [i for i, name in enumerate(names) if name not in self._known]
        if new:
            corrected = self._corrected(torch.stack([views[i] for i in new]), A)
            if corrected.alignment is None:
                return self._corrected(views, A)
            for i, one in zip(new, corrected.alignment.split(), strict=True):
                self._known[names[i]] = one
        by = Alignment.joined([self._known[name] for name in names]).to(views)
        return CorrectedViews(aligned(views, by), by)
