"""Breast-like slices: a random texture, thresholded into fibroglandular tissue and fat, enclosed by
skin, with small bright specks.

Values depend on position and the case's random numbers, not on a grid: on a finer grid, a case is
the same object.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Complex, Float
from torch import Tensor

from mvrecon.core.numbers import generator, uniform
from mvrecon.data.scenes.sample import Sample, Scene
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.ray_transform import RayTransform

#: Attenuation in 1/mm of fat, of glandular tissue and skin, and of the brightest
#: microcalcification.
ADIPOSE, FIBROGLANDULAR, BRIGHTEST = 0.0194, 0.0233, 0.026
#: Period of the texture, in radii of the breast, so that opposite sides differ.
PERIOD = 2.5
#: Spectral power falls with frequency to this power (Reiser and Nishikawa, Med. Phys. 37, 2010).
POWER = 3.0
#: Minimum and maximum fraction of fibroglandular tissue.
DENSITY = (0.15, 0.45)
#: Thickness of the skin and outer radius of the tissue below it, in radii.
SKIN, INNER = 0.03, 0.90
#: Minimum and maximum radius of specks, in radii of the breast.
SPECK = (0.006, 0.015)
#: Points per axis at which the threshold is determined.
POINTS = 64


@dataclass(frozen=True, kw_only=True)
class BreastSlices(Scene):
    """Unlimited breast-like slices in 1/mm: fat, fibroglandular tissue, skin and bright specks.

    As in the AAPM challenge on sparse-view CT (Sidky and Pan, Med. Phys. 49, 2022), whose views are
    noise-free integrals of the pixels themselves: with `fine: 1` a volume on the grid explains the
    views exactly, if the projector uses the same `method`. With a finer grid, no volume explains
    them.

    Args:
        field: radius of the breast as a fraction of the grid's shorter edge across z.
        detail: periods of the texture's finest wave across the breast's diameter.
        edge_mm: width of tissue boundaries; 0 for steps, so that the gradient is sparse.
        specks: minimum and maximum number per slice.
        fine: factor by which the grid of the projected object is finer; the truth is its block
            mean.
        method: method of the projector that makes the views.

    Raises:
        ValueError: numbers out of range.
    """

    field: float = 0.45
    detail: int = 12
    edge_mm: float = 0.0
    specks: tuple[int, int] = (5, 20)
    fine: int = 1
    method: str = "joseph"

    unit: ClassVar[str] = "1/mm"
    length: ClassVar[int | None] = None

    def __post_init__(self) -> None:
        least, most = self.specks
        if not 0 < self.field <= 0.5:
            raise ValueError(
                f"The field must be a fraction in (0, 0.5] of the grid's edge, got {self.field}"
            )
        if self.detail < 1 or self.fine < 1 or not self.edge_mm >= 0 or not 0 <= least <= most:
            raise ValueError(
                f"Expected detail and fine of at least 1, edge_mm of at least 0 and specks as "
                f"(from, to), got {self.detail}, {self.fine}, {self.edge_mm} and {self.specks}"
            )

    @property
    def data_range(self) -> float:
        """The fixed range of values that PSNR and SSIM refer to."""
        return BRIGHTEST

    def sample(self, index: int, seed: int, grid: Grid, cameras: Cameras) -> Sample:
        """Case `index` of the series `seed`: its views by `cameras` and its truth on `grid`."""
        volume = self.finer(index, seed, grid, cameras, self.fine)
        with torch.no_grad():
            A = RayTransform(grid.refined(self.fine), cameras, method=self.method)
            views = A(volume[None])[0]
        truth = F.avg_pool3d(volume, self.fine)
        return Sample(views, truth, truth > 0, f"breast-{seed}-{index}")

    def finer(
        self, index: int, seed: int, grid: Grid, cameras: Cameras, factor: int
    ) -> Float[Tensor, "1 d h w"]:
        """The case's attenuation on `grid.refined(factor)`, at the centres of its voxels.

        Slices are as thick as those of `grid`; values are constant across a slice.
        """
        rng = generator(seed, index)
        texture = random_texture(rng, self.detail)
        x_mm, y_mm, z_mm = grid.spacing
        depth, height, width = grid.shape
        radius = self.field * min(height * y_mm, width * x_mm)
        y, x = (
            centred(n * factor) * step / (factor * radius)
            for n, step in ((height, y_mm), (width, x_mm))
        )
        edge = self.edge_mm / radius
        slices = [
            slice_values(texture, random_specks(rng, self.specks), y, x, z, edge)
            for z in (centred(depth) * z_mm / radius).tolist()
        ]
        volume = torch.stack(slices).to(torch.float32).repeat_interleave(factor, dim=0)
        return volume[None]


class Specks(NamedTuple):
    """Discs in one slice, in radii of the breast.

    Args:
        centres: (x, y).
        radii: radius of each disc.
        brightness: 0 for fibroglandular tissue, 1 for the brightest microcalcification.
    """

    centres: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    brightness: Float[Tensor, " n"]


class Texture(NamedTuple):
    """A sum of waves with random phases.

    Args:
        amplitude: amplitude of each wave over (y, x), complex.
        frequency: frequency of each wave along y and along x, in radians per radius.
        axial: frequency along z of each wave, in radians per radius.
        threshold: texture values above it are fibroglandular tissue.
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
    y: Float[Tensor, " h"],
    x: Float[Tensor, " w"],
    z: float,
    edge: float,
) -> Float[Tensor, "h w"]:
    """Attenuation in 1/mm at the points of a slice.

    Args:
        texture: defines the fibroglandular tissue.
        specks: microcalcifications of this slice.
        y: positions of the slice's rows, in radii of the breast.
        x: positions of its columns, in radii of the breast.
        z: position of the slice, in radii of the breast.
        edge: width of the tissues' boundaries, linear ramps, in radii; 0 for steps.
    """
    radius = torch.hypot(y[:, None], x)
    value, slope = waves(texture, y, x, z)
    body, fat, inner = (ramp(limit - radius, edge) for limit in (1.0, 1.0 - SKIN, INNER))
    gland = ramp((value - texture.threshold) / slope.clamp_min(1e-12), edge) * inner
    mu = body * FIBROGLANDULAR - fat * (FIBROGLANDULAR - ADIPOSE) * (1 - gland)
    for centre, size, brightness in zip(*specks, strict=True):
        disc = ramp(size - torch.hypot(y[:, None] - centre[1], x - centre[0]), edge) * fat
        target = FIBROGLANDULAR + brightness * (BRIGHTEST - FIBROGLANDULAR)
        mu = torch.lerp(mu, target.expand_as(mu), disc)
    return mu


def ramp(distance: Float[Tensor, "*n"], edge: float) -> Float[Tensor, "*n"]:
    """One inside, zero outside, linear across the width of an edge; a step for zero width."""
    if edge == 0:
        return (distance > 0).to(distance.dtype)
    return (distance / edge + 0.5).clamp(0, 1)


def centred(count: int) -> Float[Tensor, " n"]:
    """Cell indices relative to the central cell."""
    return torch.arange(count, dtype=torch.float64) - (count - 1) / 2
