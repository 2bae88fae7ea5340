"""The ramp filter along detector rows, sampled in space, with the usual windows."""

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Filter = Literal["ram-lak", "shepp-logan", "cosine", "hamming", "hann"]

#: Windows of the ramp as functions of frequency over the band limit, from 0 to 1.
WINDOWS: dict[str, Callable[[Tensor], Tensor]] = {
    "ram-lak": torch.ones_like,
    "shepp-logan": lambda f: torch.sinc(f / 2),
    "cosine": lambda f: torch.cos(math.pi / 2 * f),
    "hamming": lambda f: 0.54 + 0.46 * torch.cos(math.pi * f),
    "hann": lambda f: 0.5 + 0.5 * torch.cos(math.pi * f),
}


def padded_length(columns: int) -> int:
    """The least even length of at least twice the columns without a prime factor above 5: one
    period of the filter then holds a row and its whole response.
    """
    length = max(2, 2 * columns)
    while length % 2 or _rough(length):
        length += 1
    return length


def _rough(length: int) -> bool:
    for prime in (2, 3, 5):
        while length % prime == 0:
            length //= prime
    return length > 1


def ramp_response(
    columns: int, filter: Filter = "ram-lak", cutoff: float = 1.0
) -> Float[Tensor, " frequency"]:
    """The windowed ramp filter's frequency response for rows of pixels 1 mm wide, in 1/mm.

    It is the transform of the ramp sampled in space, h(0) = 1/4, h(n) = -1 / (pi n)^2 for odd n,
    else 0, so that a constant keeps its right level (Kak and Slaney, Principles of Computerized
    Tomographic Imaging, 1988, ch. 3, eq. 61).

    Args:
        columns: pixels of a row.
        filter: the window, "ram-lak" (none), "shepp-logan", "cosine", "hamming" or "hann".
        cutoff: the band limit as a fraction of the Nyquist frequency, in (0, 1]; what lies above
            is removed.

    Raises:
        ValueError: an unknown filter, or a band limit outside (0, 1].
    """
    if filter not in WINDOWS:
        raise ValueError(f"Unknown filter {filter!r}. Known: {', '.join(WINDOWS)}")
    if not 0 < cutoff <= 1:
        raise ValueError(
            f"Expected cutoff as a fraction of the Nyquist frequency in (0, 1], got {cutoff!r}"
        )
    length = padded_length(columns)
    n = torch.arange(length, dtype=torch.float64)
    n = torch.minimum(n, length - n)
    kernel = torch.where(n % 2 == 1, -1 / (math.pi * n.clamp_min(1)) ** 2, 0.0)
    kernel[0] = 0.25
    fraction = torch.linspace(0, 1, length // 2 + 1, dtype=torch.float64) / cutoff
    window = torch.where(fraction <= 1, WINDOWS[filter](fraction), 0.0)
    return torch.fft.rfft(kernel).real * window


def filter_rows(
    views: Float[Tensor, "*n u"], response: Float[Tensor, " frequency"]
) -> Float[Tensor, "*n u"]:
    """Rows convolved with a filter of `ramp_response`, in (unit of the views) / pixel.

    Divide by the pixel pitch in mm for (unit of the views) / mm. Rows are continued by zeros.
    """
    length = 2 * (len(response) - 1)
    spectrum = torch.fft.rfft(views, n=length)
    spectrum *= response.to(views)  # in place: a spectrum is twice as large as the views
    return torch.fft.irfft(spectrum, n=length)[..., : views.shape[-1]]
