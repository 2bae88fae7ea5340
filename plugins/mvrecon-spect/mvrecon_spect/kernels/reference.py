"""Reference implementation of attenuated rays: the operators of `ops.py` in plain torch.

It uses the cells of `mvrecon.kernels.rays.reference`, or the footprints of pixels (see
`distance_driven.py`); autograd computes derivatives of any order, including those of the rays.
"""

from collections.abc import Iterator, Sequence
from itertools import islice

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from mvrecon.kernels.rays.lines import DIRECTION, START
from mvrecon.kernels.rays.reference import maps_at_pixels, rays_of, weights

#: Suffix of a method's name that disables skipping.
DENSE = ":dense"
#: The method that averages over the pixels' footprints.
DISTANCE_DRIVEN = "distance_driven"
#: See `distance_driven.py`.
STEEPEST, NARROWEST = 5.0, 0.1
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
        lines, window, detector: see `mvrecon.kernels.rays.reference.project`.
        method: "joseph" or "siddon" along the pixels' central rays, or "distance_driven".
        longest: upper bound in mm of the length of a segment, for the fixed-point unit of the CUDA
            adjoint.
    """
    flat = F.pad(volume, (1, 1) * 3).flatten(1)
    total = volume.new_zeros(len(volume), len(lines) * detector[0] * detector[1], layers.shape[1])
    dealt = [one.to(volume) for one in _dealt(lines, layers, detector, mu.shape, method)]
    for index, weight, slab in _attenuated(mu.to(volume), lines, window, detector, method):
        total = total + (weight * flat[:, index])[..., None] * dealt[slab]
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
    dealt = [one.to(views) for one in _dealt(lines, layers, detector, mu.shape, method)]
    for index, weight, slab in _attenuated(mu.to(views), lines, window, detector, method):
        value = (values * dealt[slab]).sum(dim=-1)
        flat = flat.index_add(1, index, weight * value)
    return flat.reshape(len(views), d + 2, h + 2, w + 2)[:, 1:-1, 1:-1, 1:-1]


def _attenuated(
    mu: Tensor, lines: Tensor, window: Sequence[float], detector: Sequence[int], method: str
) -> Iterator[tuple[Tensor, Tensor, int]]:
    """Flat indices and weights in mm, with the transmission from each cell to the detector, and the
    slab.
    """
    every = list(_segments(lines, window, detector, mu, method))
    flat, depths = F.pad(mu, (1, 1) * 3).flatten(), []
    for one in every:
        depths.append(torch.stack([weight * flat[index] for index, weight in one]).sum(dim=0))
    depth = torch.stack(depths)
    # counts run along the ray's direction, to its end on the detector's side
    maps, main = _axes(lines, detector, method)
    upwards = maps[DIRECTION].gather(0, main[None])[0] > 0
    before = torch.where(upwards, _above(depth), _above(depth.flip(0)).flip(0))
    shares = torch.exp(-before) * mean_transmission(depth)
    for i, (one, share) in enumerate(zip(every, shares, strict=True)):
        slab = i * max(mu.shape) // len(every)
        yield from ((index, weight * share, slab) for index, weight in one)


def _segments(
    lines: Tensor, window: Sequence[float], detector: Sequence[int], mu: Tensor, method: str
) -> Iterator[list[tuple[Tensor, Tensor]]]:
    """Flat indices and weights in mm of each segment of all rays, slab by slab."""
    if method == DISTANCE_DRIVEN:
        yield from _footprints(lines, window, detector, mu)
        return
    entries = weights(lines, window, detector, mu.shape, mu, method)
    while one := list(islice(entries, CELLS[method])):
        yield one


def _axes(lines: Tensor, detector: Sequence[int], method: str) -> tuple[Tensor, Int[Tensor, " r"]]:
    """As `maps_at_pixels`; distance-driven rays have the main axis of their view (`STEEPEST`)."""
    maps, main = maps_at_pixels(lines, detector)
    if method != DISTANCE_DRIVEN:
        return maps, main
    shared = maps_at_pixels(lines, [1, 1])[1].repeat_interleave(detector[0] * detector[1])
    speed, own = (maps[DIRECTION].gather(0, axis[None])[0].abs() for axis in (shared, main))
    return maps, torch.where(own > STEEPEST * speed, main, shared)


def _footprints(
    lines: Tensor, window: Sequence[float], detector: Sequence[int], like: Tensor
) -> Iterator[list[tuple[Tensor, Tensor]]]:
    """Flat indices and weights in mm of the voxels in the pixels' footprints, for each slab."""
    shape, (maps, main) = like.shape, _axes(lines, detector, DISTANCE_DRIVEN)
    rays = rays_of(maps, main, window, shape, like)
    order = torch.stack([main, (main + 1) % 3, (main + 2) % 3])
    D = maps[DIRECTION].gather(0, order)
    # images of a step along a row and along a column, for cones per slab from the source
    parallel = not lines[:, DIRECTION, :, :2].any()
    steps = lines[:, START if parallel else DIRECTION, :, :2].permute(2, 1, 0)
    steps = steps.repeat_interleave(detector[0] * detector[1], dim=2)
    steps = torch.stack([step.gather(0, order) for step in steps])
    images = steps[:, 1:] - D[1:] / D[0] * steps[:, :1]
    sides = images.abs().amax(dim=0)
    area = (images[0, 0] * images[1, 1] - images[0, 1] * images[1, 0]).abs()
    sides = sides * (area / sides.prod(dim=0)).sqrt()
    source, sizes = maps[START].gather(0, order[:1])[0], rays.sizes[1:]
    for slab in range(max(shape)):
        k = torch.minimum(torch.tensor(slab, device=lines.device), rays.sizes[0] - 1)
        s = k.to(like.dtype) - (rays.sizes[0] - 1) / 2
        share = torch.minimum(rays.end, s + 0.5) - torch.maximum(rays.begin, s - 0.5)
        length = share.clamp_min(0) * (rays.sizes[0] > slab) * rays.length
        width = sides if parallel else sides * ((s - source) / D[0]).abs()
        width = width.to(like.dtype).clamp_min(NARROWEST)
        low = rays.value + s * rays.slope + sizes / 2 - width / 2
        first = low.detach().floor()
        base, entries = (k + 1) * rays.strides[0], []
        ends = range(int(width.detach().max()) + 3) if width.numel() else range(3)
        parts = torch.stack([((first + j - low) / width).clamp(0, 1) for j in ends]).diff(dim=0)
        for b, part_b in enumerate(parts[:, 0]):
            for c, part_c in enumerate(parts[:, 1]):
                place = torch.stack([first[0] + b, first[1] + c])
                place = torch.minimum(place.clamp_min(-1), sizes.to(place)).long()
                index = base + ((place + 1) * rays.strides[1:]).sum(dim=0)
                entries.append((index, length * part_b * part_c))
        yield entries


def _dealt(
    lines: Tensor, layers: Tensor, detector: Sequence[int], shape: Sequence[int], method: str
) -> Iterator[Float[Tensor, "r k"]]:
    """For every slab, its fraction in each layer."""
    last = layers.shape[1] - 1
    nodes = layers.repeat_interleave(detector[0] * detector[1], dim=0)
    for w in fractions(lines, detector, shape, method):
        if not last:
            yield torch.ones_like(nodes)
            continue
        along = (1 / w - nodes[:, 0]) * last / (nodes[:, -1] - nodes[:, 0])
        # the centre of a slab that contains the source may be behind it: use the nearest layer
        along = torch.where(w * nodes[:, 0] >= 0, along, 0)
        steps = torch.arange(last + 1, device=w.device)
        yield (1 - (along.clamp(0, last)[:, None] - steps).abs()).clamp_min(0)


def fractions(
    lines: Tensor, detector: Sequence[int], shape: Sequence[int], method: str = "joseph"
) -> Iterator[Float[Tensor, " r"]]:
    """Parameter w from source to pixel at the centres of the rays' slabs."""
    maps, main = _axes(lines, detector, method)
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
