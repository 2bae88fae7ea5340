"""Volumes as Interfile (.hv and .v), as STIR reads and writes them."""

import warnings
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats.common import to_ras
from mvrecon.geometry.grid import Grid
from mvrecon_spect.attenuated import check_mu
from mvrecon_spect.files.interfile import (
    check_repeated,
    numbers_of,
    read_header,
    write_interfile,
)

#: 1/mm per 1/cm.
PER_CM = 0.1
#: In 1/cm: if no voxel exceeds it, the values may be in 1/mm; lung has about 0.04 at 140.5 keV.
THIN = 0.03


def read_interfile(
    path: str | Path, world: str = "RAS", place: Literal["centred", "header"] = "centred"
) -> tuple[Float[Tensor, "d h w"], Grid]:
    """Read an Interfile volume: its stored values as float32, and its grid in mm.

    Args:
        path: path of the header.
        world: axes of the file, see `mvrecon.geometry.cameras.formats.common.to_ras`.
        place: "centred": the centre of the volume is the origin; "header": the first voxel's centre
            is at the header's `first pixel offset (mm)`.

    Convention: STIR's pinhole projector treats volumes as centred and ignores the header. STIR's
    headers place the origin at voxel N // 2, half a voxel off centre for even N, and at the first
    slice.

    Raises:
        FileNotFoundError: the header or the data file does not exist.
        Refused: missing keys, a size that does not match the file, or values that are not finite.
    """
    header = read_header(path)
    if place not in ("centred", "header"):
        raise ValueError(f"Expected the place centred or header, got {place!r}")
    size = [header.whole(f"matrix size[{axis}]") for axis in (1, 2, 3)]
    if min(size) < 1:
        raise Refused(f"{path}: expected three positive sizes, got {size}")
    spacing = [header.positive(f"scaling factor (mm/pixel)[{axis}]") for axis in (1, 2, 3)]
    numbers = numbers_of(header, size[::-1], "volume")
    slices = ["number of slices", "total number of images"]
    check_repeated(header, slices, size[2], "as matrix size [3]")
    apart = ["centre-centre slice separation (pixels)"]
    check_repeated(header, apart, spacing[2] / spacing[0], "by the scaling factors")
    values = torch.from_numpy(numbers.read(0, size[2]))
    if not values.isfinite().all():
        raise Refused(f"{path}: expected finite values, got some that are not")
    centre = [0.0, 0.0, 0.0]
    if place == "header":
        first = [header.number(f"first pixel offset (mm)[{axis}]") for axis in (1, 2, 3)]
        centre = [f + s * (n - 1) / 2 for f, s, n in zip(first, spacing, size, strict=True)]
    grid = Grid.centred(size=size, spacing=spacing, centre=centre)
    return values, grid.moved(to_ras(world), torch.zeros(3))


def write_interfile_volume(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write an Interfile volume in float32 (.hv and .v).

    Args:
        path: path of the header, ending in .hv.
        volume: values on the grid.
        grid: with axes along x, y and z; its first voxel's centre is the `first pixel offset (mm)`.

    Raises:
        ValueError: a wrong file extension, a shape other than the grid's, or a rotated grid.
    """
    path = Path(path)
    turned = grid.affine[:3, :3] - torch.diag(torch.tensor(grid.spacing, dtype=torch.float64))
    if (
        path.suffix.lower() != ".hv"
        or tuple(volume.shape) != grid.shape
        or turned.abs().max() > 1e-9
    ):
        raise ValueError(
            f"{path}: expected a name that ends in .hv and a volume of its grid, whose axes are x, "
            f"y, z, got {tuple(volume.shape)} for {grid.shape} with the axes "
            f"{grid.affine[:3, :3].tolist()}"
        )
    lines = [
        "!imaging modality := nucmed",
        "!version of keys := STIR4.0",
        "number of dimensions := 3",
    ]
    for axis, name in enumerate("xyz"):
        lines += [
            f"matrix axis label [{axis + 1}] := {name}",
            f"!matrix size [{axis + 1}] := {grid.size[axis]}",
            f"scaling factor (mm/pixel) [{axis + 1}] := {grid.spacing[axis]!r}",
            f"first pixel offset (mm) [{axis + 1}] := {grid.affine[axis, 3].item()!r}",
        ]
    write_interfile(path, ".v", lines, volume.detach().cpu().numpy())


def read_mu(path: str | Path, world: str = "RAS") -> tuple[Float[Tensor, "d h w"], Grid]:
    """Read linear attenuation in STIR's unit, 1/cm, and return it in 1/mm with its grid.

    Warns:
        UserWarning: the values are so small that they may be in 1/mm.

    Raises:
        FileNotFoundError, Refused: see `read_interfile`.
        ValueError: negative, not finite, or too large for 1/cm.
    """
    values, grid = read_interfile(path, world)
    check_mu(values * PER_CM, grid)
    if 0 < (most := values.max().item()) < THIN:
        warnings.warn(
            f"{path}: the greatest attenuation is {most:g} / cm, a tenth of water's at 140.5 keV "
            f"(0.1536); is the file in 1/mm?",
            stacklevel=2,
        )
    return values * PER_CM, grid


def write_mu(path: str | Path, mu: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write linear attenuation given in 1/mm in STIR's unit, 1/cm.

    Raises:
        ValueError: values that cannot be attenuation in 1/mm; see `write_interfile_volume`.
    """
    check_mu(mu, grid)
    write_interfile_volume(path, mu / PER_CM, grid)
