"""What an operator says of its pixels, where they are weighted integrals along lines."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class PixelIntegral:
    """A pixel's value is a weight times the mean integral along lines through it, in (unit of the
    volume) * mm times the weight's unit.

    Args:
        weight: of each pixel, broadcasts to [m v u]; one: the integral itself.
        rays: lines each way over which a pixel is the mean, spread evenly; 1: the line through its
            centre.
    """

    weight: Tensor
    rays: int = 1

    @classmethod
    def plain(cls, rays: int = 1) -> "PixelIntegral":
        """The line integral itself."""
        return cls(torch.ones((), dtype=torch.float64), rays)

    def weighted(self, factors: Tensor | None) -> "PixelIntegral":
        """The same lines with further factors of the pixels."""
        return self if factors is None else replace(self, weight=self.weight * factors)


def sees_integrals(A: "SaysPixelIntegral") -> bool:
    """Whether an operator says that its pixels are line integrals themselves, without weight."""
    pixel = A.pixel_integral()
    return pixel is not None and bool((pixel.weight == 1).all())


class SaysPixelIntegral:
    """An operator that may say how its pixels are made of line integrals.

    A subclass that computes something else in `forward` says nothing, unless it says it anew.
    """

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "forward" in vars(cls) and "pixel_integral" not in vars(cls):
            cls.pixel_integral = SaysPixelIntegral.pixel_integral

    def pixel_integral(self) -> PixelIntegral | None:
        """How a pixel is made of integrals along lines; None: otherwise, or not known."""
        return None

    def attenuation(self) -> Float[Tensor, "d h w"] | None:
        """What attenuates emission along a pixel's lines, in 1/mm on the grid; None: nothing, or
        not known.
        """
        return None
