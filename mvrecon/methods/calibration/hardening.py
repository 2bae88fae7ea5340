"""The polynomial that corrects beam hardening, fitted to the views of a uniform object.

Behind a length L of the object the beam measures a growing function p of L, and the polynomial maps
p to mu L. The lengths are those of a reconstruction of the same views, thresholded at half of the
object's value: cupping does not move its border. (Kachelriess, Sourbelle and Kalender, Empirical
cupping correction, Med. Phys. 33, 2006, compare with a segmented phantom likewise.)
"""

import math
import warnings
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.numbers import second_differences
from mvrecon.methods.classical.fdk import fdk
from mvrecon.methods.classical.truncation import CUT_EDGE, edge_shares, ends_of
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
#: Share of the voxels at the grid's sides that are the object's, at most: of noise.
MAX_CUT = 0.1
#: Of a uniform object in a beam that hardens: greatest residual beyond noise (with three holes
#: 1.4 %), and least slope of the polynomial, which grows from one.
MAX_RESIDUAL, MIN_SLOPE = 0.015, 0.95


class Linearisation(NamedTuple):
    """A polynomial fitted to the views of a uniform object.

    Args:
        coefficients: c1 = 1, c2, ..., without a unit.
        value: value of the object in the corrected volume, in 1/mm.
        residual: root mean square of value L - sum c_k p^k over the fitted rays, relative to that
            of value L.
    """

    coefficients: list[float]
    value: float
    residual: float


def fit_linearisation(A: Projector, views: Float[Tensor, "1 1 m v u"]) -> Linearisation:
    """Fit c1 p + c2 p^2 + ... to the views of a uniform object in air, such as a cylinder of water.

    The correction leaves thin objects as they are, c1 = 1; multiply all coefficients by
    mu / value to give the object a known attenuation mu. An object that is denser at its rim looks
    as if the beam hardened more, and is not told from that.

    Args:
        A: the operator of a circular scan, with a grid that holds the object across the axis of
            rotation.
        views: line integrals.

    Raises:
        ValueError: views that `fdk` refuses, that show no object, or one that ends beyond the
            detector or the grid; lengths that no growing polynomial describes.

    Warns:
        UserWarning: lengths that are not those of one uniform object in a hardening beam.
    """
    if (share := edge_shares(ends_of(views))[:, 1].max()) > CUT_EDGE:
        raise ValueError(
            f"Expected the views of a uniform object in air to fit a polynomial to, got line "
            f"integrals of {share:.0%} of the greatest ones in the outermost columns: the object "
            f"ends beyond the detector, or the flat field differs from air"
        )
    with warnings.catch_warnings():  # a reconstruction of the corrected views warns of the same
        warnings.simplefilter("ignore")
        volume = fdk(A, views)
    top = volume.flatten().sort().values[-max(1, round(OBJECT_SHARE * volume.numel()))]
    threshold = volume[volume > top / 2].mean() / 2
    inside = volume > threshold
    sides = [inside[..., 0, :], inside[..., -1, :], inside[..., 0], inside[..., -1]]
    if top > 0 and torch.cat(sides, dim=-1).float().mean() > MAX_CUT:
        raise ValueError(
            "Expected a grid that holds the object across the axis of rotation to fit a polynomial "
            "to its views, got voxels of the object in its outermost columns or rows"
        )
    lengths = A(inside.to(volume))
    rows = views.shape[-2]
    few = max(1, round(FITTED_ROWS * rows))
    first = (rows - few) // 2
    p, lengths = (y[..., first : first + few, :].double().cpu() for y in (views, lengths))
    used = lengths > MIN_LENGTH * lengths.max()
    if not top > 0 or int(used.sum()) < MIN_RAYS * DEGREE:
        raise ValueError(
            f"Expected the views of a uniform object to fit a polynomial to, got {int(used.sum())} "
            f"rays through one"
        )
    off = torch.zeros_like(p)
    p, lengths = p[used], lengths[used]
    powers = p[:, None] ** torch.arange(1, DEGREE + 1)
    scale = powers.norm(dim=0)
    found = torch.linalg.lstsq(powers / scale, lengths[:, None], rcond=1e-9).solution[:, 0] / scale
    off[used] = powers @ found - lengths
    residual = (off.square().mean() / lengths.square().sum() * off.numel()).sqrt().item()
    fit = Linearisation((found / found[0]).tolist(), 1 / found[0].item(), residual)
    _check(fit, off, used, p.max().item(), lengths.norm().item())
    return fit


def _check(
    fit: Linearisation,
    off: Float[Tensor, "1 1 m v u"],
    used: Bool[Tensor, "1 1 m v u"],
    most: float,
    norm: float,
) -> None:
    """Refuse or warn of a fit to what is not a uniform object.

    Args:
        fit: the polynomial.
        off: deviation of the polynomial from the lengths, in mm.
        used: fitted rays.
        most: greatest line integral of these.
        norm: norm of the lengths of these rays, in mm.
    """
    places = torch.linspace(0, most, 257, dtype=torch.float64)
    slope = sum(k * c * places ** (k - 1) for k, c in enumerate(fit.coefficients, start=1))
    least = torch.as_tensor(slope).min().item()
    if not (fit.value > 0 and least > 0):
        raise ValueError(
            f"Expected the views of a uniform object to fit a polynomial to, which grows with the "
            f"length, got {fit.coefficients}, with a value of {fit.value:.3g}/mm"
        )
    # noise differs between neighbours; what the object or the rig has wrong does not
    three = used[..., 2:] & used[..., 1:-1] & used[..., :-2]
    rough = second_differences(off)[three].square().mean()
    beyond = max(0.0, fit.residual**2 - rough.item() * int(used.sum()) / norm**2)
    if math.sqrt(beyond) > MAX_RESIDUAL or least < MIN_SLOPE:
        warnings.warn(
            f"The views are hardly those of one uniform object in a beam that hardens: the "
            f"polynomial leaves {math.sqrt(beyond):.1%} of the lengths beyond noise, expected at "
            f"most {MAX_RESIDUAL:.1%}, and its slope falls to {least:.2f}, expected at least "
            f"{MIN_SLOPE} (several materials, scatter, noise, or a rig that is wrong?); do not use "
            f"it for other scans",
            stacklevel=3,
        )
