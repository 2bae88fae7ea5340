"""Linear attenuation in 1/mm, from a tensor, a number or a file, on a grid and outside it, or per
case.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import check_options
from mvrecon.data.resample import resample
from mvrecon.geometry.grid import Grid
from mvrecon.kernels.rays.cpu.skip_policy import box_of, readable
from mvrecon_spect.files.interfile_volume import check_mu, read_mu

#: Values of the option `mu` that name a map of each case, and its key in a batch.
MAPS = {"case": "mu", "measured": "mu_measured"}

#: Tolerance in voxels for a map whose box coincides with the grid's.
SAME = 1e-3
#: 1/mm: upper bound of the median over a body's voxels (water at 140.5 keV 0.01536, at 70 keV
#: 0.0192; lung in 1/cm, 0.04, exceeds it), and lower bound of its maximum.
TISSUE, WATERY = 0.025, 0.006


#: Linear attenuation as an option of projectors, see `mvrecon_spect.operators.projector.Spect`.
MuOption: TypeAlias = (
    Float[Tensor, "d h w"]
    | float
    | Literal["case", "measured"]
    | str
    | Path
    | Mapping[str, Any]
    | None
)


class Matter(NamedTuple):
    """Linear attenuation in 1/mm, and its grid; zero outside it."""

    mu: Float[Tensor, "e i j"]
    grid: Grid


def attenuation_on(grid: Grid, mu: Float[Tensor, "d h w"] | float | str | Path) -> Matter:
    """Linear attenuation in 1/mm on a grid, and the part of a map outside it.

    Args:
        grid: the voxels.
        mu: a tensor on the grid, a uniform value, or the path of a volume in 1/mm (Interfile, .hv:
            1/cm), which is resampled to the grid with zeros outside the file.

    Warns:
        UserWarning: values unusual for a patient, such as in another unit, or a file that ends
            within matter and within the grid.

    Raises:
        TypeError: not a tensor, number or path.
        ValueError: values that cannot be attenuation in 1/mm, a tensor of the wrong shape, or a map
            whose matter is entirely outside the grid.
    """
    if isinstance(mu, str | Path):
        from mvrecon.data.volume_files import read_volume

        interfile = Path(mu).suffix.lower() == ".hv"
        values, source = (read_mu if interfile else read_volume)(mu)
        check_mu(values, source)
        if not interfile:  # read_mu warns by itself
            _doubt(values, str(mu))
        half = torch.tensor(grid.size) / 2
        matter = source.cropped(box_of(readable(values[None]))) if values.any() else source
        low, high = (grid.to_index(matter.corners()) - grid.centre_index).aminmax(dim=0)
        if (low > half).any() or (high < -half).any():
            raise ValueError(
                f"{mu}: expected attenuation in the grid about {_point(grid.centre)}, or around "
                f"it, got all of it elsewhere, in a map about {_point(source.centre)}; look at mm, "
                f"cm and the axes of the file"
            )
        _warn_of_cut(values, source, grid, str(mu))
        corners = (grid.to_index(source.corners()) - grid.centre_index).abs()
        if (corners > half + SAME).any():
            return Matter(values, source)
        return Matter(resample(values, source, grid).clamp_min(0), grid)
    if not isinstance(mu, Tensor | float | int):
        raise TypeError(f"Expected mu as a tensor, number or path in 1/mm, got {mu!r}")
    values = mu if isinstance(mu, Tensor) else torch.full(grid.shape, float(mu))
    check_mu(values, grid)
    _doubt(values, "mu")
    return Matter(values, grid)


def _doubt(values: Float[Tensor, "d h w"], name: str) -> None:
    """Warn about attenuation that is implausible for a patient."""
    most = values.detach().max()
    if not most:
        return
    typical = values.detach()[values > 0.1 * most].median().item()
    if typical > TISSUE:
        got, cause = f"{typical:.3g} in half of what attenuates", "is it in 1/cm"
    elif most < WATERY:
        got, cause = f"at most {most.item():.3g}", "was it divided by 10 twice"
    else:
        return
    warnings.warn(
        f"{name}: expected attenuation in 1/mm (water at 140.5 keV: 0.01536), got {got}; {cause}?",
        stacklevel=4,
    )


def _warn_of_cut(values: Float[Tensor, "d h w"], source: Grid, grid: Grid, name: str) -> None:
    """Warn about a map that ends in matter before the grid ends."""
    low, high = source.to_index(grid.corners()).aminmax(dim=0)
    for axis, (n, step) in enumerate(zip(source.size, source.spacing, strict=True)):
        for end, beyond in ((0, -0.5 - low[axis]), (n - 1, high[axis] - n + 0.5)):
            further = step * beyond.item()
            matter = values.select(2 - axis, end).max() > WATERY
            if matter and further > max(step, *grid.spacing):
                warnings.warn(
                    f"{name}: expected a map of the whole body, got matter at its end along "
                    f"{'xyz'[axis]}; the grid reaches {further:.3g} mm further, where nothing "
                    f"attenuates",
                    stacklevel=4,
                )


def _point(place: Float[Tensor, "3"]) -> str:
    """Format a point (x, y, z) in mm."""
    return f"({', '.join(f'{x:g}' for x in place.tolist())}) mm"


@dataclass(frozen=True)
class CaseAttenuation:
    """Linear attenuation of each case, in 1/mm.

    Args:
        name: key of the map in a batch, "mu" or "mu_measured".
        shift_mm: misalignment of the map relative to the case, along (x, y, z).
    """

    name: str
    shift_mm: tuple[float, ...] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, mu: Any) -> "CaseAttenuation | None":
        """Parse the option `mu`: "case", "measured", or `{of: case, shift_mm: [x, y, z]}`; None for
        any other value.

        Raises:
            TypeError: a mapping with unknown keys.
            ValueError: an unknown map, or a shift that is not three finite numbers.
        """
        if not isinstance(mu, Mapping):
            return cls(MAPS[mu]) if isinstance(mu, str) and mu in MAPS else None
        check_options("projector.mu", mu, ("of", "shift_mm"))
        name = mu.get("of", "case")
        shift = tuple(float(step) for step in mu.get("shift_mm", cls.shift_mm))
        if name not in MAPS or len(shift) != 3 or not torch.tensor(shift).isfinite().all():
            raise ValueError(
                f"Expected projector.mu of case or measured, and a shift_mm of three finite "
                f"numbers, got {dict(mu)}"
            )
        return cls(MAPS[name], shift)

    def maps_of(self, batch: Mapping[str, Any], grid: Grid) -> list[Float[Tensor, "d h w"]]:
        """The shifted maps of the cases of a batch, in 1/mm.

        Raises:
            ValueError: cases without the map.
        """
        if self.name not in batch:
            scenes = {"mu": "cardiac or nema", "mu_measured": "spect_ct"}[self.name]
            raise ValueError(
                f"Expected cases with {self.name!r} for this projector.mu, as of the scene "
                f"{scenes}, got {sorted(batch)}"
            )
        maps = [mu[0].cpu() for mu in batch[self.name]]
        if not any(self.shift_mm):
            return maps
        affine = grid.affine.clone()
        affine[:3, 3] += torch.tensor(self.shift_mm, dtype=affine.dtype)
        moved = Grid(grid.shape, affine)
        return [resample(mu, moved, grid).clamp_min(0) for mu in maps]
