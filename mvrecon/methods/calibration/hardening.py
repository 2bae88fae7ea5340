"""The polynomial that corrects beam hardening, fitted to the views of a uniform object.

Behind a length L of the object the beam measures a growing function p of L, and the polynomial maps
p to mu L. The lengths are those of a reconstruction of the same views, thresholded at half of the
object's value: cupping does not move its border. (Kachelriess, Sourbelle and Kalender, Empirical
cupping correction, Med. Phys. 33, 2006, compare with a segmented phantom likewise.)
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.methods.classical.fdk import fdk
from mvrecon.operators.operator import Projector

#: Coefficients: cupping of 0.05 % is left of 200 mm of water at 80 and 120 kV, with two 0.6 %.
DEGREE = 3
#: Share of the rows, about the middle one, whose rays do not leave the grid through its ends.
FITTED_ROWS = 0.25
#: Shorter lengths, relative to the longest one, are left out: they are off by a part of a voxel.
MIN_LENGTH = 0.3
#: At least this share of the voxels is the object's.
OBJECT_SHARE = 0.01
#: Least number of rays per coefficient.
MIN_RAYS = 10


class Linearisation(NamedTuple):
    """A polynomial fitted to the views of a uniform object.

    Args:
        coefficients: c1 = 1, c2, ..., without a unit.
        value: of the object in the corrected volume, in 1/mm.
        residual: root mean square of value L - sum c_k p^k over the fitted rays, relative to that
            of value L.
    """

    coefficients: list[float]
    value: float
    residual: float


def fit_linearisation(A: Projector, views: Float[Tensor, "1 1 m v u"]) -> Linearisation:
    """Fit c1 p + c2 p^2 + ... to the views of a uniform object in air, such as a cylinder of water.

    The correction leaves thin objects as they are, c1 = 1; multiply all coefficients by
    mu / value to give the object a known attenuation mu.

    Args:
        A: the operator of a circular scan, with a grid that holds the object across the axis of
            rotation.
        views: line integrals.

    Raises:
        ValueError: views that `fdk` refuses, or that show no object.
    """
    volume = fdk(A, views)
    top = volume.flatten().sort().values[-max(1, round(OBJECT_SHARE * volume.numel()))]
    threshold = volume[volume > top / 2].mean() / 2
    lengths = A((volume > threshold).to(volume))
    rows = views.shape[-2]
    few = max(1, round(FITTED_ROWS * rows))
    first = (rows - few) // 2
    p, lengths = (y[..., first : first + few, :].flatten().double().cpu() for y in (views, lengths))
    used = lengths > MIN_LENGTH * lengths.max()
    if not top > 0 or int(used.sum()) < MIN_RAYS * DEGREE:
        raise ValueError(
            f"Expected the views of a uniform object to fit a polynomial to, got {int(used.sum())} "
            f"rays through one"
        )
    p, lengths = p[used], lengths[used]
    powers = p[:, None] ** torch.arange(1, DEGREE + 1)
    scale = powers.norm(dim=0)
    found = torch.linalg.lstsq(powers / scale, lengths[:, None]).solution[:, 0] / scale
    residual = (powers @ found - lengths).norm() / lengths.norm()
    return Linearisation((found / found[0]).tolist(), 1 / found[0].item(), residual.item())
