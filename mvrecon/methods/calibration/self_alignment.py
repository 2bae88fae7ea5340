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
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.parts import CORRECTIONS
from mvrecon.kernels.device_cache import device_cached, grid_key
from mvrecon.methods.calibration.alignment import CorrectedViews, aligned, alignment
from mvrecon.methods.calibration.from_data import motions
from mvrecon.methods.classical.sirt import sirt, sirt_weights
from mvrecon.methods.learned.start import CACHE_BYTES, fingerprints
from mvrecon.methods.method import Alignment, Reconstruction, build_method
from mvrecon.operators.operator import Projector, check_finite, check_views

#: Shifts in pixels, and gains, below which a camera counts as standing still.
STILL_PX, STILL_GAIN = 0.03, 0.003
#: Of the median over the cameras: the mean density along a view's rays, below and above which the
#: view is lost (dead, overexposed).
LOST = (0.01, 3.0)
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
    """Views as cameras without shift (pixels) and wrong gain would have measured them, both
    estimated from the views alone and returned as `alignment`. A lost view (dead or overexposed),
    whose gain is zero, is replaced by the projection of the volume of all others, as in expectation
    maximisation with missing data.

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
    rays = (weights.row > 0).sum(dim=(1, 3, 4))
    level = (weights.row * views.abs()).sum(dim=(1, 3, 4)) / rays
    low, high = (bound * level.median(dim=1, keepdim=True).values for bound in LOST)
    lost = (level < low) | (level > high)
    present = (~lost)[:, None, :, None, None]
    expected = (views * present).sum(dim=2, keepdim=True) / present.sum(dim=2, keepdim=True)
    for _ in range(alternations):
        y = _filled(aligned(views, by), lost, expected)
        volume = sirt(A, y, iterations, weights=weights, momentum=True, start=volume)
        expected = A(volume)
        fitted = alignment(_filled(views, lost, expected), expected, start=by, steps=1)
        by = standing_still(fitted, moves)
    by = replace(by, gain=by.gain.masked_fill(lost, 0))
    return CorrectedViews(_filled(aligned(views, by), lost, expected), by)


def _filled(
    views: Float[Tensor, "b 1 m v u"],
    lost: Bool[Tensor, "b m"],
    expected: Float[Tensor, "b 1 #m v u"],
) -> Float[Tensor, "b 1 m v u"]:
    """Views with the expected ones in place of those that are lost."""
    return torch.where(lost[:, None, :, None, None], expected, views)


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

    The alignment is not differentiated. In training the corrected views of each case are computed
    once and kept, as long as there is room; the views of every step are read on the host for this.

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
        self._known: dict[bytes, tuple[Tensor, Alignment]] = {}
        self._room = CACHE_BYTES

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        # an alignment to parts of a pixel needs float32
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views, A) if self.training else self._corrected(views, A)
        return replace(self.method(corrected.views, A), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        return CORRECTIONS.from_config(self.correct, A, views)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        """The corrected views of a batch, recalled where they are known."""
        names = fingerprints(views)
        cases = {name: self._known[name] for name in names if name in self._known}
        new = [i for i, name in enumerate(names) if name not in cases]
        if new:
            corrected = self._corrected(torch.stack([views[i] for i in new]), A)
            if corrected.alignment is None:
                return self._corrected(views, A)
            parts = corrected.views.split(1), corrected.alignment.split()
            for i, y, by in zip(new, *parts, strict=True):
                cases[names[i]] = y, by
                if y.nbytes <= self._room:
                    self._room -= y.nbytes
                    self._known[names[i]] = y.cpu(), by.to("cpu")
        together = torch.cat([cases[name][0].to(views) for name in names])
        by = Alignment.joined([cases[name][1].to(views) for name in names])
        return CorrectedViews(together, by)
