"""FDK of cone beams and FBP of parallel and fan beams, by a projector's grid and cameras."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.methods.classical.filtered.filters import Filter
from mvrecon.methods.classical.filtered.scan_weights import ScanKind
from mvrecon.methods.classical.filtered.streaming import Filtering, filtered_backprojection
from mvrecon.operators.checks import check_measured
from mvrecon.operators.operator import Projector, Scaled


def fdk(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    scan: ScanKind = "auto",
    weights_from: Cameras | None = None,
) -> Float[Tensor, "b c d h w"]:
    """FDK reconstructs a cone-beam scan on a circle by filtered back-projection, in (unit of the
    views) / mm.

    Any camera of the record will do whose sources lie roughly on a circle and whose rows run
    across its axis: steps may be uneven, detectors shifted and turned. The method is exact in the
    plane of the sources, and approximate above and below it. Linear, and differentiable in the
    views (Feldkamp, Davis and Kress, Practical cone-beam algorithm, JOSA A 1, 1984).

    Args:
        A: the operator, whose grid and cameras are used.
        views: line integrals.
        filter: the ramp's window, "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: band limit as a fraction of the detector's Nyquist frequency, in (0, 1].
        scan: "full", "short" (Parker's weights; 180 degrees and the fan suffice), "offset" (Wang's
            weights; a whole turn with the detector to one side), or "auto": an offset is taken for
            one if the detector's narrow side does not reach around the grid's inscribed cylinder.
        weights_from: the rig that weights and filter belong to, where it is not the one that is
            back-projected with: the ideal geometry of a misaligned scanner (Karolczak and others,
            Med. Phys. 28, 2001). None: A's own.

    Raises:
        ValueError: parallel beams, sources that are not on a circle, angles that do not suffice,
            views that do not fit or are not finite, an unknown option, or an operator with weights.
    """
    cameras = _plain(A, "fdk")
    if cameras.parallel:
        raise ValueError("fdk needs a cone or fan beam, got parallel beams; use fbp")
    return _reconstruct(A, views, Filtering(filter, cutoff, scan, weights_from))


def fbp(
    A: Projector,
    views: Float[Tensor, "b c m v u"],
    filter: Filter = "ram-lak",
    cutoff: float = 1.0,
    scan: ScanKind = "auto",
) -> Float[Tensor, "b c d h w"]:
    """Filtered back-projection reconstructs slices from parallel or fan beams, in (unit of the
    views) / mm.

    Parallel beams: one slice, a stack of slices, or a volume; angles in any order, over 180 degrees
    or more, with uneven steps. Fan beams: a flat detector of one row in the plane of the sources, a
    slice; a stack of slices is a batch. Linear, and differentiable in the views (Kak and Slaney,
    Principles of Computerized Tomographic Imaging, 1988, ch. 3).

    Args:
        A: the operator, whose grid and cameras are used.
        views: line integrals.
        filter, cutoff, scan: as `fdk`.

    Raises:
        ValueError: a cone beam, angles that do not suffice, views that do not fit or are not
            finite, an unknown option, or an operator with weights.
    """
    cameras = _plain(A, "fbp")
    if not cameras.parallel and cameras.shape[0] > 1:
        raise ValueError(
            f"fbp needs parallel beams or fans of one row, got a cone beam of {cameras.shape[0]} "
            f"rows; use fdk"
        )
    return _reconstruct(A, views, Filtering(filter, cutoff, scan))


def _plain(A: Projector, name: str) -> Cameras:
    """The cameras of an operator that integrates along their rays and no more."""
    if isinstance(A, Scaled):
        raise ValueError(
            f"{name} needs plain line integrals, got an operator with weights, "
            f"{type(A).__name__}; use sirt or mlem"
        )
    if not (hasattr(A, "grid") and hasattr(A, "cameras")):
        raise ValueError(
            f"{name} needs an operator with a grid and cameras, got {type(A).__name__}; use sirt"
        )
    return A.cameras


def _reconstruct(
    A: Projector, views: Float[Tensor, "b c m v u"], filtering: Filtering
) -> Float[Tensor, "b c d h w"]:
    check_measured(views, "views [b c m v u]", (len(A.cameras), *A.cameras.shape), views.device)

    def read(first: int, last: int) -> Tensor:
        return views[:, :, first:last]

    volumes = views.shape[0] * views.shape[1]
    x = filtered_backprojection(read, A.cameras, A.grid, volumes, filtering)
    support = getattr(A, "support", None)
    return x if support is None else torch.where(support, x, 0)
