"""Linear attenuation on a grid, in 1/mm, from a tensor, a number or a file."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.grid import Grid
from mvrecon.projectors.attenuated import check_mu

#: What a map of each case's own needs.
OF_CASES = (
    "; each case's own map is known to mvrecon-train and mvrecon-eval alone, with a scene that "
    "attenuates (cardiac, nema, spect_ct)"
)


def attenuation_on(
    grid: Grid, mu: Float[Tensor, "d h w"] | float | str | Path
) -> Float[Tensor, "d h w"]:
    """Linear attenuation in 1/mm on a grid.

    Args:
        grid: the voxels.
        mu: a tensor on the grid, a number for all of it, or the path of a volume in 1/mm (of
            Interfile, .hv, in 1/cm), which is resampled to the grid, and zero outside of its own.

    Raises:
        TypeError: no tensor, number or path, such as the name of a map of each case.
        ValueError: values that cannot be attenuation in 1/mm, a tensor of another shape, or a map
            whose matter all lies outside of the grid.
    """
    if isinstance(mu, str | Path) and str(mu) not in ("case", "measured"):
        from mvrecon.data.resample import resample
        from mvrecon.data.volume_files import read_volume
        from mvrecon_spect.files.interfile_volume import read_mu

        values, source = (read_mu if Path(mu).suffix.lower() == ".hv" else read_volume)(mu)
        check_mu(values, source)
        on_grid = resample(values, source, grid).clamp_min(0)
        if values.any() and not on_grid.any():
            raise ValueError(
                f"{mu}: expected attenuation in the grid about {_point(grid.centre)}, got all of "
                f"it elsewhere, in a map about {_point(source.centre)}; look at mm, cm and the "
                f"axes of the file"
            )
        return on_grid
    if not isinstance(mu, Tensor | float | int):
        raise TypeError(f"Expected mu as a tensor, number or path in 1/mm, got {mu!r}{OF_CASES}")
    values = mu if isinstance(mu, Tensor) else torch.full(grid.shape, float(mu))
    check_mu(values, grid)
    return values


def _point(place: Float[Tensor, "3"]) -> str:
    """A place as words, (x, y, z) in mm."""
    return f"({', '.join(f'{x:g}' for x in place.tolist())}) mm"
