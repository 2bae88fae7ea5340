"""What speaks against a reconstruction although nothing failed: mirrored views, counts taken for
line integrals, a volume that does not explain its views.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.field import resolution
from mvrecon.data.projections.region import Region
from mvrecon.engine.coarse import coarse
from mvrecon.engine.scan import Scan
from mvrecon.metrics import nrmse
from mvrecon.parts import PROJECTORS
from mvrecon.reconstruct.iterative import sirt

#: Voxels along the grid's longest side, views, and iterations of SIRT that tell mirrored views.
VOXELS, VIEWS, ITERATIONS = 32, 40, 8
#: Reversed views are told where they leave less than this part of the residual.
BETTER = 0.75
#: View NRMSE above which a volume does not explain its views.
POOR = 0.25
#: Line integral that no X-ray comes through: 2e-9 of it does.
OPAQUE = 20.0
#: Projectors of line integrals.
LINES = ("drr", "radon")
#: Reconstructors of counts, and of whatever a network was trained on.
OF_COUNTS = ("bsrem", "mlem", "osem", "trained", "tv_map")
CURES = {
    "columns": "does the rig turn the other way (camera.clockwise, the sign of the angles), or are "
    "the images mirrored (views.flip_columns=true)? The two volumes are mirror images",
    "rows": "do the rows of the views run upwards (views.flip_rows=true)?",
}


def doubts(scan: Scan, method: str, view_nrmse: float, device: str = "cpu") -> list[str]:
    """What speaks against a scan's reconstruction, in words, without a unit; empty for most.

    Args:
        scan: that was reconstructed.
        method: name of the reconstructor.
        view_nrmse: |y - A x| / |y| of its volume.
        device: for the comparison.
    """
    words, first = [], scan.measured.read(0, 1).views
    whole = first.equal(first.round())
    if scan.projector["name"] in LINES:
        if method not in OF_COUNTS and first.max() > OPAQUE and whole:
            words.append(
                f"expected line integrals, got whole numbers up to {first.max().item():g}; grey "
                f"values want views.kind=intensities and views.flat, counts of emission osem"
            )
        figures = reversed_nrmse(scan, device)
        stored, best = figures["stored"], min(figures, key=lambda name: figures[name])
        if figures[best] < BETTER * stored:
            words.append(
                f"views with their {best} reversed fit the rig better, view NRMSE "
                f"{figures[best]:.2g} in place of {stored:.2g} (SIRT on a coarse grid); "
                f"{CURES[best]}"
            )
    elif method in OF_COUNTS and view_nrmse > POOR and not whole:
        words.append(
            f"expected counts, got numbers that are not whole, which the volume does not explain "
            f"(view NRMSE {view_nrmse:.2g}); projector=drr is for line integrals"
        )
    if view_nrmse > POOR and not words:
        words.append(
            f"the volume does not explain the views (view NRMSE {view_nrmse:.2g}); look at "
            f"rig.png, and whether lengths are mm, the views whole, the grid large enough, and a "
            f"network was trained for such views"
        )
    return words


def reversed_nrmse(scan: Scan, device: str = "cpu") -> dict[str, float]:
    """The view NRMSE of a coarse volume by SIRT, of the views as they are stored, and with their
    columns or rows reversed: a rig whose sense of rotation is wrong has the views of a mirrored
    object.

    Reversed rows of a circular scan are those of a mirrored object, and fit as well.
    """
    grid = coarse(scan.grid, VOXELS)
    size = max(1, int(max(grid.spacing) / resolution(scan.cameras, grid.centre)))
    rows, columns = scan.cameras.shape
    joined = (min(size, rows), min(size, columns))
    kept = (0, rows - rows % joined[0]), (0, columns - columns % joined[1])
    region = Region.of((rows, columns), kept[0], kept[1], joined)
    numbers = range(0, len(scan.cameras), math.ceil(len(scan.cameras) / VIEWS))
    rig = region.seen_by(scan.cameras[torch.tensor(numbers)])
    A = PROJECTORS.build(scan.projector["name"], grid=grid, cameras=rig).to(device)
    parts = [_as_all(scan.measured.read(n, n + 1).views, region) for n in numbers]
    views = torch.stack(parts, dim=1)[:, None].to(device)
    with torch.no_grad():
        again = A(sirt(A, views, ITERATIONS, momentum=True))
    names = ("stored", "columns", "rows")
    return {name: nrmse(a, y) for name, a, y in zip(names, again, views, strict=True)}


def _as_all(view: Float[Tensor, "1 v u"], region: Region) -> Float[Tensor, "3 i j"]:
    """A view as it is stored, with reversed columns, and with reversed rows, binned."""
    return region.binned(region.cropped(torch.cat([view, view.flip(-1), view.flip(-2)])))
