"""Shifts and gains of misaligned cameras from the measured views alone, alternating with
reconstruction.

Views are reconstructed, aligned with the volume's views, and reconstructed again (alignment by
re-projection: Dengler, Ultramicroscopy 30, 1989). Common modes of all cameras - motion of the
object, its scale - are chosen by least absolute deviations, such that most cameras have no error;
few misaligned cameras do not affect these (Bloomfield & Steiger, Least Absolute Deviations, 1983).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvrecon.core.parts import CORRECTIONS
from mvrecon.methods.calibration.alignment import CorrectedViews, aligned, alignment
from mvrecon.methods.calibration.from_data import motions
from mvrecon.methods.classical.sirt import sirt, sirt_weights
from mvrecon.methods.learned.start import Cases
from mvrecon.methods.method import Alignment, Reconstruction, build_method
from mvrecon.operators.memo import grid_key, kept, place
from mvrecon.operators.operator import Projector, check_finite, check_views

#: Shifts in pixels, and gains, below which a camera counts as error-free.
STILL_PX, STILL_GAIN = 0.03, 0.003
#: A view whose mean density along its rays is below or above these parts of the median over the
#: cameras is lost: dead, or overexposed.
LOST = (0.01, 2.0)
#: Modes that move less than this part of the total are not shared by the cameras.
NOT_SHARED = 1e-10
#: Iterations of reweighted least squares for the least absolute deviations.
REWEIGHTED = 10


@torch.no_grad()
def self_aligned(
    A: Projector,
    views: Float[Tensor, "b 1 m v u"],
    alternations: int = 4,
    iterations: int = 8,
) -> CorrectedViews:
    """Estimate shifts (pixels) and gains from the views alone, and correct the views.

    The errors are returned as `alignment`. A lost view (dead or overexposed; gain 0) is replaced by
    the projection of the volume of all others, as in expectation maximisation with missing data.

    Args:
        A: the operator of the nominal cameras; its grid must hold the whole object.
        alternations: of reconstruction and alignment.
        iterations: of SIRT with momentum in each, from the previous volume.

    Raises:
        ValueError: non-finite views (not checked on a GPU, where the volume then is not finite
            either), or no alternation.
    """
    if alternations < 1:
        raise ValueError(f"expected at least one alternation, got {alternations}")
    check_finite(views, on_gpu=False)
    by, volume, weights = Alignment.none(views), None, sirt_weights(A, views.dtype)
    cameras, centre = A.cameras, A.grid.centre
    moves = kept(
        cameras,
        ("motions", grid_key(A.grid), place(views)),
        lambda: motions(cameras, centre).detach().to(views.device),
    )
    # a mean of densities would be the noise of the rays that graze the grid
    lengths = torch.where(weights.row > 0, 1 / weights.row, 0)
    level = (views.abs() * (lengths > 0)).sum(dim=(1, 3, 4)) / lengths.sum(dim=(1, 3, 4))
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
    """Replace lost views by the expected ones."""
    return torch.where(lost[:, None, :, None, None], expected, views)


def standing_still(by: Alignment, moves: Float[Tensor, "m 2 3"]) -> Alignment:
    """Remove a motion of the object from an alignment's shifts (pixels) and a common factor from
    its gains, such that most cameras have no error.

    Otherwise an object that misaligned cameras have displaced is taken for the true one.

    Args:
        by: the alignment.
        moves: effect of a motion of the object in the views, by `motions`.
    """
    shift = least_deviations(by.shift_px, moves.to(by.shift_px.device), STILL_PX)
    common = by.gain.new_ones(by.gain.shape[1], 1, 1)
    gain = least_deviations(by.gain.log()[..., None], common, STILL_GAIN)
    return replace(by, shift_px=shift, gain=gain[..., 0].exp())


def least_deviations(
    values: Float[Tensor, "b m k"], modes: Float[Tensor, "m k q"], floor: float
) -> Float[Tensor, "b m k"]:
    """Subtract the combination of modes that leaves the least sum of lengths; in the values' unit.

    Args:
        values: of each camera.
        modes: common to all cameras.
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
        # too little to affect other than zero modes; a pseudo-inverse would synchronise
        damping = (NOT_SHARED * total + torch.finfo(values.dtype).eps) * unit
        shared = flat @ torch.linalg.inv_ex(normal + damping)[0] @ slope
        rest = values - shared.view_as(values)
    return rest.to(dtype)


class Aligned(nn.Module):
    """Reconstruction by another method from aligned views, in the unit of (views / mm).

    The alignment is not differentiated. In training the corrected views of each case are computed
    once, see `Cases`.

    Args:
        method: name and options of the method.
        correct: name and options of the correction.

    Raises:
        LookupError: an unknown name.
        TypeError: an unknown option of a part.
    """

    def __init__(self, method: Mapping[str, Any], correct: Mapping[str, Any] | None = None):
        super().__init__()
        self.method = build_method(method)
        self.correct = dict(correct or {"name": "align"})
        CORRECTIONS.check(self.correct)
        self._cases = Cases()

    def forward(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> Reconstruction:
        check_views(views, A.cameras)
        # sub-pixel alignment needs float32
        with torch.no_grad(), torch.autocast(views.device.type, enabled=False):
            corrected = self._recalled(views, A) if self.training else self._corrected(views, A)
        return replace(self.method(corrected.views, A), alignment=corrected.alignment)

    def _corrected(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        return CORRECTIONS.from_config(self.correct, A, views)

    def _recalled(self, views: Float[Tensor, "b 1 m v u"], A: Projector) -> CorrectedViews:
        """The corrected views of a batch, computed once for each case."""

        def made(samples: Sequence[int]) -> list[Tensor]:
            y, by = self._corrected(views[samples], A.of_samples(samples))
            return [y] if by is None else [y, *by.tensors()]

        y, *by = self._cases(made, A, self.correct, views)
        return CorrectedViews(y, Alignment(*by) if by else None)
