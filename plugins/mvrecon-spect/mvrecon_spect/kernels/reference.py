"""Reference implementation of attenuated rays: the operators of `ops.py` in plain torch.

It uses the cells of `mvrecon.kernels.rays.reference`; autograd computes derivatives of any order,
including those of the rays.
"""

from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.rays.lines import DIRECTION, START
from mvrecon.kernels.rays.reference import maps_at_pixels, weights

#: Suffix of a method's name that disables skipping.
DENSE = ":dense"
#: Cells per segment of constant attenuation.
CELLS = {"joseph": 4, "siddon": 1}
#: Optical depth below which (1 - exp(-m)) / m is evaluated by its series.
SERIES = 1e-3


def project(
    volume: Float[Tensor, "n d h w"],
    mu: Float[Tensor, "d h w"],
    lines: Float[Tensor, "m 4 3 c"],
    layers: Float[Tensor, "m k"],
    window: Sequence[float],
    longest: float,
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u k"]:
    """Attenuated line integrals of volumes, in mm times their unit.

    A ray segment i with emission l_i and optical depth m_i contributes l_i exp(-A_i) (1 -
    exp(-m_i)) / m_i, where A_i is the optical depth between the segment and the detector.

    Args:
        volume: emission per mm.
        mu: linear attenuation in 1/mm on the same grid.
        layers: layers of every view at equal steps of 1 / w, among which the integral is
            distributed linearly; one layer contains all of it.
        lines, window, detector, method: see `mvrecon.kernels.rays.reference.project`; "trilinear"
            is not supported.
        longest: upper bound in mm of the length of a segment, for the fixed-point unit of the CUDA
            adjoint.
    """
    flat = F.pad(volume, (1, 1) * 3).flatten(1)
    total = volume.new_zeros(len(volume), len(lines) * detector[0] * detector[1], layers.shape[1])
    dealt = _dealt(lines, layers, detector, mu.shape, method)
    for index, weight in _attenuated(mu.to(volume), lines, window, detector, method):
        total = total + (weight * flat[:, index])[..., None] * next(dealt).to(volume)
    return total.reshape(len(volume), len(lines), *detector, layers.shape[1])


def backproject(
    views: Float[Tensor, "n m v u k"],
    mu: Float[Tensor, "d h w"],
    lines: Float[Tensor, "m 4 3 c"],
    layers: Float[Tensor, "m k"],
    window: Sequence[float],
    longest: float,
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project` with respect to the emission."""
    d, h, w = mu.shape
    flat, values = views.new_zeros(len(views), (d + 2) * (h + 2) * (w + 2)), views.flatten(1, 3)
    detector = views.shape[2:4]
    dealt = _dealt(lines, layers, detector, mu.shape, method)
    for index, weight in _attenuated(mu.to(views), lines, window, detector, method):
        value = (values * next(dealt).to(views)).sum(dim=-1)
        flat = flat.index_add(1, index, weight * value)
    return flat.reshape(len(views), d + 2, h + 2, w + 2)[:, 1:-1, 1:-1, 1:-1]


def _attenuated(
    mu: Tensor, lines: Tensor, window: Sequence[float], detector: Sequence[int], method: str
) -> Iterator[tuple[Tensor, Tensor]]:
    """Flat indices and weights in mm, with the transmission from each cell to the detector."""
    entries = list(weights(lines, window, detector, mu.shape, mu, method))
    flat, size = F.pad(mu, (1, 1) * 3).flatten(), CELLS[method]
    depths = torch.stack([weight * flat[index] for index, weight in entries])
    depth = depths.unflatten(0, (-1, size)).sum(dim=1)
    # counts run along the ray's direction, to its end on the detector's side
    maps, main = maps_at_pixels(lines, detector)
    upwards = maps[DIRECTION].gather(0, main[None])[0] > 0
    before = torch.where(upwards, _above(depth), _above(depth.flip(0)).flip(0))
    shares = torch.exp(-before) * mean_transmission(depth)
    for i, (index, weight) in enumerate(entries):
        yield index, weight * shares[i // size]


def _dealt(
    lines: Tensor, layers: Tensor, detector: Sequence[int], shape: Sequence[int], method: str
) -> Iterator[Float[Tensor, "r k"]]:
    """For every entry of `_attenuated`, its fraction in each layer."""
    last = layers.shape[1] - 1
    per_slab = {"joseph": 4, "siddon": 3}[method]
    nodes = layers.repeat_interleave(detector[0] * detector[1], dim=0)
    for w in fractions(lines, detector, shape):
        if not last:
            hats = torch.ones_like(nodes)
        else:
            along = (1 / w - nodes[:, 0]) * last / (nodes[:, -1] - nodes[:, 0])
            # the centre of a slab that contains the source may be behind it: use the nearest layer
            along = torch.where(w * nodes[:, 0] >= 0, along, 0)
            steps = torch.arange(last + 1, device=w.device)
            hats = (1 - (along.clamp(0, last)[:, None] - steps).abs()).clamp_min(0)
        yield from [hats] * per_slab


def fractions(
    lines: Tensor, detector: Sequence[int], shape: Sequence[int]
) -> Iterator[Float[Tensor, " r"]]:
    """Parameter w from source to pixel at the centres of the rays' slabs."""
    maps, main = maps_at_pixels(lines, detector)
    start, D = maps[START].gather(0, main[None])[0], maps[DIRECTION].gather(0, main[None])[0]
    sizes = torch.tensor(shape[::-1], device=lines.device)[main]
    for slab in range(max(shape)):
        yield (torch.clamp(sizes - 1, max=slab) - (sizes - 1) / 2 - start) / D


def _above(depth: Float[Tensor, "k r"]) -> Float[Tensor, "k r"]:
    """Sum of the optical depths of all later segments."""
    later = depth.flip(0).cumsum(dim=0)[:-1].flip(0)
    return torch.cat([later, torch.zeros_like(depth[:1])])


def mean_transmission(m: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Mean transmission (1 - exp(-m)) / m within segments of optical depth m >= 0."""
    safe = torch.where(m < SERIES, torch.ones_like(m), m)
    series = 1 - m / 2 * (1 - m / 3 * (1 - m / 4 * (1 - m / 5)))
    return torch.where(m < SERIES, series, -torch.expm1(-safe) / safe)
