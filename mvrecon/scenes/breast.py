"""Breast-like slices: a texture of random waves, thresholded into fibroglandular tissue and fat,
within skin, with small bright specks.

Everything is a function of the place and of the case's random numbers, not of a grid: the same case
on a finer grid is the same object.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from mvrecon.scenes.analytic import uniform

#: The texture's period, in radii of the breast: opposite sides do not repeat.
PERIOD = 2.5
#: Spectral power falls with frequency to this power (Reiser and Nishikawa, Med. Phys. 37, 2010).
POWER = 3.0
#: Share of the breast that is fibroglandular tissue, from and to.
DENSITY = (0.15, 0.45)
#: In radii: thickness of the skin, and where the tissue under it begins.
SKIN, INNER = 0.03, 0.90
#: Radii of specks in radii of the breast, from and to.
SPECK = (0.006, 0.015)
#: Points each way at which the threshold is chosen.
POINTS = 64


@dataclass(frozen=True)
class Tissues:
    """Attenuation of the tissues in 1/mm.

    Args:
        adipose: fat.
        fibroglandular: glands and skin.
        speck: the brightest microcalcification.
    """

    adipose: float = 0.0194
    fibroglandular: float = 0.0233
    speck: float = 0.026


class Specks(NamedTuple):
    """Discs in one slice, in radii of the breast.

    Args:
        centres: (x, y).
        radii: of the discs.
        brightness: part of the way from fibroglandular tissue to the brightest speck.
    """

    centres: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    brightness: Float[Tensor, " n"]


class Texture(NamedTuple):
    """A sum of waves with random phases.

    Args:
        amplitude: of waves over (y, x), complex.
        frequency: along y and along x, in radians per radius.
        axial: frequency along z of each wave, in radians per radius.
        threshold: above it there is fibroglandular tissue.
    """

    amplitude: Complex[Tensor, "k k"]
    frequency: Float[Tensor, " k"]
    axial: Float[Tensor, "k k"]
    threshold: float = 0.0


def random_texture(rng: torch.Generator, detail: int) -> Texture:
    """A texture of random waves, of at most `detail` periods across the breast's diameter."""
    count = math.ceil(detail * PERIOD / 2)
    index = torch.arange(-count, count + 1, dtype=torch.float64)
    frequency = 2 * math.pi / PERIOD * index
    size = torch.hypot(index[:, None], index)
    phases = 2 * math.pi * torch.rand(size.shape, generator=rng, dtype=torch.float64)
    strength = torch.randn(size.shape, generator=rng, dtype=torch.float64)
    axial = torch.randn(size.shape, generator=rng, dtype=torch.float64)
    band = (size > 0) & (size <= count)
    weight = torch.where(band, size.clamp_min(1) ** (-POWER / 2), 0.0) * strength
    axial = axial * size * 2 * math.pi / PERIOD / math.sqrt(2)
    texture = Texture(torch.polar(weight.abs(), phases), frequency, axial)
    line = torch.linspace(-INNER, INNER, POINTS, dtype=torch.float64)
    within = torch.hypot(line[:, None], line) < INNER
    values = waves(texture, line, line, 0.0)[0][within]
    density = uniform(rng, *DENSITY)
    return texture._replace(threshold=torch.quantile(values, 1 - density).item())


def waves(
    texture: Texture, y: Float[Tensor, " h"], x: Float[Tensor, " w"], z: float
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """The texture at the points of a slice, and the size of its gradient per radius."""
    k = texture.frequency
    amplitude = texture.amplitude * torch.polar(torch.ones_like(texture.axial), z * texture.axial)
    along_y, along_x = (
        torch.polar(torch.ones(len(p), len(k), dtype=k.dtype), p[:, None] * k) for p in (y, x)
    )
    value, by_y, by_x = (
        (rows @ amplitude @ columns.T).real
        for rows, columns in (
            (along_y, along_x),
            (along_y * (1j * k), along_x),
            (along_y, along_x * (1j * k)),
        )
    )
    return value, torch.hypot(by_y, by_x)


def random_specks(rng: torch.Generator, count: tuple[int, int]) -> Specks:
    """Specks of one slice, in up to three clusters."""
    low, high = count
    n = int(torch.randint(low, high + 1, (), generator=rng))
    homes = 1.2 * torch.rand(3, 2, generator=rng, dtype=torch.float64) - 0.6
    home = torch.randint(3, (n,), generator=rng)
    centres = homes[home] + 0.08 * torch.randn(n, 2, generator=rng, dtype=torch.float64)
    least, most = SPECK
    radii = least + (most - least) * torch.rand(n, generator=rng, dtype=torch.float64)
    return Specks(centres, radii, 0.3 + 0.7 * torch.rand(n, generator=rng, dtype=torch.float64))


def slice_values(
    texture: Texture,
    specks: Specks,
    tissues: Tissues,
    y: Float[Tensor, " h"],
    x: Float[Tensor, " w"],
    z: float,
    edge: float,
) -> Float[Tensor, "h w"]:
    """Attenuation in 1/mm at the points of a slice.

    Args:
        texture: where fibroglandular tissue is.
        specks: of this slice.
        tissues: attenuation in 1/mm.
        y: of the slice's rows, in radii of the breast.
        x: of its columns.
        z: of the slice.
        edge: width of the tissues' boundaries, linear ramps, in radii; 0 for steps.
    """
    radius = torch.hypot(y[:, None], x)
    value, slope = waves(texture, y, x, z)
    body, fat, inner = (ramp(limit - radius, edge) for limit in (1.0, 1.0 - SKIN, INNER))
    gland = ramp((value - texture.threshold) / slope.clamp_min(1e-12), edge) * inner
    gap = tissues.fibroglandular - tissues.adipose
    mu = body * tissues.fibroglandular - fat * gap * (1 - gland)
    for centre, size, brightness in zip(*specks, strict=True):
        disc = ramp(size - torch.hypot(y[:, None] - centre[1], x - centre[0]), edge) * fat
        target = tissues.fibroglandular + brightness * (tissues.speck - tissues.fibroglandular)
        mu = torch.lerp(mu, target.expand_as(mu), disc)
    return mu


def ramp(distance: Float[Tensor, "*n"], edge: float) -> Float[Tensor, "*n"]:
    """One inside, zero outside, linear over the width of an edge; a step where it is zero."""
    if edge == 0:
        return (distance > 0).to(distance.dtype)
    return (distance / edge + 0.5).clamp(0, 1)
