"""Volumes as Interfile (.hv and .v), as STIR reads and writes them."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.checks import Refused
from mvrecon.geometry.cameras.formats.common import to_ras
from mvrecon.geometry.grid import Grid
from mvrecon.operators.checks import check_floating
from mvrecon_spect.files.interfile import (
    Header,
    check_repeated,
    numbers_of,
    read_header,
    write_interfile,
)
from mvrecon_spect.files.interfile_keys import IMAGES

#: 1/mm per 1/cm.
PER_CM = 0.1
#: Upper bound of linear attenuation in 1/mm in a patient above 70 keV (cortical bone 0.058,
#: titanium 0.07); water and tissue in 1/cm exceed it.
DENSEST = 0.1
#: In 1/cm: if no voxel exceeds it, the values may be in 1/mm; lung has about 0.04 at 140.5 keV.
THIN = 0.03
#: The header's key for the centre of the first voxel, one per axis.
OFFSET = "first pixel offset (mm)"
#: The `originating system` of files that mvrecon writes, in lower case.
SYSTEM = "mvrecon"
#: Tolerances in voxels: of STIR's offsets, which have six digits, and of axes along x, y and z.
ROUNDED, STRAIGHT = 1e-3, 1e-6


def read_interfile(
    path: str | Path, world: str = "RAS", place: Literal["header", "centred"] = "header"
) -> tuple[Float[Tensor, "d h w"], Grid]:
    """Read an Interfile volume: its stored values as float32, and its grid in mm.

    Args:
        path: path of the header.
        world: axes of the file, see `mvrecon.geometry.cameras.formats.common.to_ras`.
        place: "header": the first voxel's centre is at the header's `first pixel offset (mm)`;
            without offsets the centre of the volume is the origin. "centred": it always is.

    Convention: STIR's `first pixel offset (mm)` is the centre of the first voxel, N // 2 voxels
    before its origin along x and y and at it along z. Where these offsets state the origin 0, which
    is STIR's default, its pinhole projector and this function centre the axis; in a file of mvrecon
    (`originating system`) every offset is a position. CASToR's offsets displace a centred volume.

    Raises:
        FileNotFoundError: the header or the data file does not exist.
        Refused: missing keys, offsets of some axes only or all 0 in a file of another program, a
            volume that CASToR displaced, a size that does not match the file, or values that are
            not finite.
    """
    header = read_header(path, "volume")
    if place not in ("centred", "header"):
        raise ValueError(f"Expected the place centred or header, got {place!r}")
    slices, apart = "number of slices", "centre-centre slice separation (pixels)"
    third = slices if _only(header, slices, "matrix size [3]") else "matrix size [3]"
    size = [header.whole(key) for key in ("matrix size [1]", "matrix size [2]", third)]
    if min(size) < 1:
        raise Refused(f"{path}: expected three positive sizes, got {size}")
    scales = [f"scaling factor (mm/pixel) [{axis}]" for axis in (1, 2, 3)]
    spacing = [header.positive(key) for key in scales[:2]]
    own = _only(header, apart, scales[2])  # as in Interfile 3.3, without a third axis
    spacing.append(spacing[0] * header.positive(apart) if own else header.positive(scales[2]))
    check_repeated(header, [slices, *IMAGES], size[2], f"as {third}")
    check_repeated(
        header,
        [apart, "slice thickness (pixels)"],
        spacing[2] / spacing[0],
        "by the scaling factors",
        1e-3,
    )
    values = torch.from_numpy(numbers_of(header, size[::-1]).read(0, size[2]))
    if not values.isfinite().all():
        raise Refused(f"{path}: expected finite values, got some that are not")
    first = _first_voxel(header, size, spacing) if place == "header" else _centred(size, spacing)
    affine = torch.diag(torch.tensor([*spacing, 1.0], dtype=torch.float64))
    affine[:3, 3] = torch.tensor(first, dtype=torch.float64)
    grid = Grid((size[2], size[1], size[0]), affine)
    return values, grid.moved(to_ras(world), torch.zeros(3))


def _only(header: Header, key: str, other: str) -> bool:
    """Whether a header has a key, but not another one with the same meaning."""
    return bool(header.values.get(key)) and not header.values.get(other)


def _centred(size: Sequence[int], spacing: Sequence[float]) -> list[float]:
    """The first voxel's centre of a volume about the origin."""
    return [-s * (n - 1) / 2 for n, s in zip(size, spacing, strict=True)]


def _first_voxel(header: Header, size: Sequence[int], spacing: Sequence[float]) -> list[float]:
    """The first voxel's centre in mm by the header; see `read_interfile`."""
    keys = [f"{OFFSET} [{axis}]" for axis in (1, 2, 3)]
    known = [key for key in keys if header.values.get(key)]
    centred = _centred(size, spacing)
    if not known:
        return centred
    if len(known) < 3:
        raise Refused(f"{header.path}: expected {OFFSET!r} of all axes or of none, got {known}")
    first = [header.number(key) for key in keys]
    if header.text("originating system", "none") == SYSTEM:
        return first
    if header.values.get("castor version"):
        if any(first):
            raise Refused(
                f"{header.path}: expected {OFFSET!r} 0 in a file of CASToR, where it displaces the "
                f"volume, got {first}; state the first voxel's centre, without 'CASToR version'"
            )
        return centred
    if not any(first) and max(size[:2]) > 1:
        raise Refused(
            f"{header.path}: expected {OFFSET!r} as the first voxel's centre, got 0 for all axes, "
            f"which may also mean that it is unknown; without these lines the volume is centred"
        )
    usual = [-s * (n // 2) for n, s in zip(size[:2], spacing, strict=False)] + [0.0]
    steps = zip(first, usual, centred, spacing, strict=True)
    return [c if abs(f - u) <= ROUNDED * s else f for f, u, c, s in steps]


def write_interfile_volume(path: str | Path, volume: Float[Tensor, "d h w"], grid: Grid) -> None:
    """Write an Interfile volume in float32 (.hv and .v), for `read_interfile` and STIR.

    The centre of the first voxel is the `first pixel offset (mm)`. A volume about the origin has no
    offsets, as in STIR's own pinhole measurements: its origin in STIR is that of other images
    without offsets, which STIR requires of an attenuation map.

    Args:
        path: path of the header, ending in .hv.
        volume: finite values on the grid.
        grid: a grid with axes along x, y and z.

    Raises:
        ValueError: a wrong file extension, a shape other than the grid's, values that are not
            finite in float32, or axes that are rotated or reversed, which Interfile cannot hold.
    """
    path, values = Path(path), volume.detach().cpu().float()
    spacing, first = list(grid.spacing), grid.affine[:3, 3].tolist()
    turned = grid.affine[:3, :3] - torch.diag(torch.tensor(spacing, dtype=torch.float64))
    if (
        path.suffix.lower() != ".hv"
        or tuple(volume.shape) != grid.shape
        or turned.abs().max() * max(grid.size) > STRAIGHT * min(spacing)
    ):
        raise ValueError(
            f"{path}: expected a name that ends in .hv and a volume of its grid, whose axes are x, "
            f"y, z, got {tuple(volume.shape)} for {grid.shape} with the axes "
            f"{grid.affine[:3, :3].tolist()}; Interfile holds no others, NIfTI does"
        )
    if bad := int((~values.isfinite()).sum()):
        raise ValueError(f"{path}: expected finite values, got {bad} that are not in float32")
    lines = [
        "!imaging modality := nucmed",
        f"originating system := {SYSTEM}",
        "!version of keys := STIR4.0",
        "number of dimensions := 3",
    ]
    for axis, name in enumerate("xyz"):
        lines += [
            f"matrix axis label [{axis + 1}] := {name}",
            f"!matrix size [{axis + 1}] := {grid.size[axis]}",
            f"scaling factor (mm/pixel) [{axis + 1}] := {spacing[axis]!r}",
        ]
    if first != _centred(grid.size, spacing):
        lines += [f"{OFFSET} [{axis}] := {place!r}" for axis, place in enumerate(first, 1)]
    write_interfile(path, ".v", lines, values.numpy())


def check_mu(mu: Tensor, grid: Grid) -> None:
    """Check the shape and the range of linear attenuation in 1/mm.

    Raises:
        ValueError: a wrong shape or dtype, or values that are not finite, negative, or above 0.1 /
            mm.
    """
    if tuple(mu.shape) != tuple(grid.shape):
        raise ValueError(f"Expected mu [d h w] of sizes {grid.shape}, got {tuple(mu.shape)}")
    check_floating(mu, "mu")
    if not mu.isfinite().all():
        raise ValueError("Expected finite attenuation in 1/mm, got values that are not")
    least, most = mu.detach().min().item(), mu.detach().max().item()
    if least < 0:
        raise ValueError(f"Expected attenuation in 1/mm, zero or more, got {least:g}; is it HU?")
    if most > DENSEST:
        raise ValueError(
            f"Expected attenuation in 1/mm, at most {DENSEST:g} (water at 140.5 keV: 0.01536), got "
            f"{most:g}; is it in 1/cm, or HU?"
        )


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
    write_interfile_volume(path, mu.double() / PER_CM, grid)  # also from half precision
