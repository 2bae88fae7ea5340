"""Write line integrals as a detector's 16-bit TIFF images with a dark and a flat field."""

import math
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import PART_ENDING, naming
from mvrecon.core.files.checks import Refused
from mvrecon.data.projections.stack import VIEWS

#: The largest grey value of 16 bits.
MAX_GREY = 2**16 - 1


@dataclass(frozen=True)
class Exposure:
    """Conversion of line integrals to 16-bit grey values.

    Args:
        photons: number of photons of an unattenuated pixel (I0), with Poisson noise; None: no
            noise.
        dark: grey value without a beam.
        flat: grey value without an object; the range up to 65535 is for noise.
        seed: seed of the noise.

    Raises:
        ValueError: grey values that do not fit into 16 bits, or no photons.
    """

    photons: float | None = 1e4
    dark: int = 100
    flat: int = 50_000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.dark < self.flat <= MAX_GREY:
            raise ValueError(
                f"Expected 0 <= dark < flat <= {MAX_GREY} grey values, got {self.dark} and "
                f"{self.flat}"
            )
        if self.photons is not None and not 0 < self.photons < np.inf:
            raise ValueError(f"Expected a positive number of photons, got {self.photons}")

    def grey(
        self, integrals: Float[Tensor, "v u"], generator: torch.Generator
    ) -> Float[Tensor, "v u"]:
        """Grey values of a view, rounded: dark + (flat - dark) N / I0 with a Poisson number N.

        Raises:
            Refused: integrals so far below zero that 16 bits would not hold them without noise.
        """
        light = (-integrals.double()).exp()
        # noise may exceed the range, as a detector saturates
        least = -math.log((MAX_GREY - self.dark) / (self.flat - self.dark))
        if light.max() > math.exp(-least):
            raise Refused(
                f"Expected line integrals of {least:.3g} or more, got "
                f"{integrals.min().item():.3g}: the grey values {self.dark} without a beam and "
                f"{self.flat} without an object leave 16 bits for no more light; lower `flat`"
            )
        if self.photons is not None:
            light = torch.poisson(self.photons * light, generator) / self.photons
        return (self.dark + (self.flat - self.dark) * light).round().clamp(max=MAX_GREY)


def write_projections(
    folder: str | Path,
    integrals: Float[Tensor, "m v u"] | Iterable[Float[Tensor, "v u"]],
    exposure: Exposure | None = None,
) -> Path:
    """Write line integrals as a folder of 16-bit TIFF images: view_00000.tif and so on, dark.tif
    and flat.tif without noise. The folder is written atomically.

    `Measured(path=folder)` reads it.

    Args:
        folder: folder of the images, new or empty.
        integrals: line integrals of the views; an iterable is consumed one view at a time.
        exposure: photons and grey values; None: 1e4 photons.

    Raises:
        FileExistsError: the folder is not empty.
        Refused: integrals that are not finite or too far below zero, see `Exposure.grey`; views of
            several sizes, no view, or too many.
    """
    folder = Path(folder).expanduser()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder}: expected a new or an empty folder for projections")
    exposure = exposure or Exposure()
    generator = torch.Generator().manual_seed(exposure.seed)
    with _folder_written_whole(folder) as part:
        shape = None
        for number, view in enumerate(integrals):
            shape = shape or tuple(view.shape)
            if number >= VIEWS:
                raise Refused(f"{folder}: expected at most {VIEWS} views, got more")
            if view.ndim != 2 or tuple(view.shape) != shape:
                raise Refused(
                    f"{folder}: expected views [v u] of the size {shape}, got "
                    f"{tuple(view.shape)} of view {number}"
                )
            if bad := int((~view.isfinite()).sum()):
                raise Refused(
                    f"{folder}: expected finite line integrals, got {bad} that are not in view "
                    f"{number}"
                )
            _write(part / f"view_{number:05d}.tif", exposure.grey(view.detach().cpu(), generator))
        if shape is None:
            raise Refused(f"{folder}: expected at least one view to write, got none")
        for name in ("dark", "flat"):
            _write(part / f"{name}.tif", torch.full(shape, float(getattr(exposure, name))))
    return folder


def _write(path: Path, grey: Float[Tensor, "v u"]) -> None:
    """Write grey values as a 16-bit TIFF."""
    from PIL import Image as Pillow

    Pillow.fromarray(grey.numpy().astype(np.uint16)).save(path, format="TIFF")


@contextmanager
def _folder_written_whole(folder: Path) -> Iterator[Path]:
    """Context of a temporary folder that is renamed to `folder` on success."""
    part = folder.with_name(f".{folder.name}.{os.getpid()}{PART_ENDING}")
    part.mkdir(parents=True)
    try:
        with naming(folder):
            yield part
            if folder.exists():
                folder.rmdir()
            os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
