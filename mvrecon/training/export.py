"""Export of a case: volumes as NIfTI, views and planes as images, measured views as HDF5."""

import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from itertools import count
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.files.atomic import PART_ENDING, write_text
from mvrecon.data.attenuation import check_unit_of_views, hounsfield
from mvrecon.data.dataset import Batch
from mvrecon.data.nifti import save_nifti
from mvrecon.data.projections.stack import MU_FILE
from mvrecon.data.projections.writing import Exposure, write_projections
from mvrecon.data.storage import written
from mvrecon.geometry.grid import Grid
from mvrecon.report.viz import review
from mvrecon.report.viz.images import save_png

#: Line integral that leaves one of 16 bits' grey values.
MAX_LINE_INTEGRAL = 10.0
#: Relative rounding of counts in float32 that were divided by their dose.
COUNT_ROUNDING = 2.0**-22


def save_case(
    folder: Path,
    scene: Batch,
    volumes: Mapping[str, Tensor],
    grid: Grid,
    data_range: float,
    earlier: Iterable[Path] = (),
) -> Path:
    """Write one scene: `views.png`, `planes.png`, and with nibabel `truth.nii.gz` and a volume for
    each method.

    Returns the scene's own folder in `folder`, see `numbered`.
    """
    case = folder / file_name(numbered(scene["name"][0], earlier))
    truth = scene["volume"][0, 0]
    shown = {label: volume[0, 0] for label, volume in volumes.items()}
    save_png(case / "views.png", review.mosaic(scene["views"][0, 0]))
    heading = review.CaseSheets(scene["name"][0], grid, data_range)
    save_png(case / "planes.png", review.planes(heading, truth, shown))
    if find_spec("nibabel"):
        for label, volume in {"truth": truth, **shown}.items():
            save_nifti(case / f"{label}.nii.gz", volume, grid)
    return case


def save_views(
    folder: Path,
    name: str,
    views: Float[Tensor, "m v u"],
    unit: str,
    attenuated: bool = False,
    dose: float | None = None,
    duration_s: float | None = None,
) -> Path:
    """Write the views of one case as `views.h5`.

    `views.h5` holds `views` [m v u], float32, with the attributes `axes`, `unit` and, of attenuated
    counts, `attenuated`; and the case's `name`. Counts are stored as such, in the unit "counts",
    with the attributes `dose` and `duration` (s), and `unit_per_dose`, that of counts / dose.

    Args:
        folder: folder of all cases.
        name: name of the case and its subfolder, which is returned.
        views: line integrals, or another projector's output.
        unit: unit of the views: "1/mm * mm" and the like of line integrals, or "<projector> of
            <unit>".
        attenuated: whether they are counts that the map of `save_truth`, else `projector.mu`,
            attenuated.
        dose: expected counts per unit of the views; None: they are no counts.
        duration_s: duration of the measurement of counts, in s; None: unknown.

    Raises:
        ValueError: a dose or a duration that is not positive and finite, or views that are not
            finite in float32, or in a unit that is neither.
    """
    check_unit_of_views(unit)
    case, about = folder / file_name(name), {"unit": unit}
    values = views.detach().cpu().double()
    for key, number in {"dose": dose, "duration": duration_s}.items():
        if number is not None and not 0 < number < math.inf:
            raise ValueError(f"Expected a positive {key}, got {number}")
    if dose is not None:
        values = values * dose
        whole = values.round()  # Poisson numbers, which views in float32 hold up to rounding
        values = torch.where((values - whole).abs() <= COUNT_ROUNDING * whole.abs(), whole, values)
        about = {"unit": "counts", "unit_per_dose": unit, "dose": float(dose)}
        about |= {} if duration_s is None else {"duration": float(duration_s)}
    if bad := int((~values.float().isfinite()).sum()):
        raise ValueError(f"Expected finite views of {name}, got {bad} pixels that are not")
    with written(case / "views.h5") as file:
        file.attrs["name"] = name
        stored = values.float().numpy()
        dataset = file.create_dataset("views", data=stored, compression="gzip", shuffle=True)
        dataset.attrs.update(axes="camera, v, u", **about)
        if attenuated:
            dataset.attrs["attenuated"] = True
    return case


def save_truth(
    case: Path,
    volume: Float[Tensor, "d h w"],
    unit: str,
    grid: Grid,
    mu: Float[Tensor, "d h w"] | None = None,
) -> None:
    """Write the true volume of a case as `truth.nii.gz`, and its linear attenuation in 1/mm, if it
    has one, as `mu.nii.gz`, for `projector.mu`; both in the rig's world in mm.

    1/mm is converted to Hounsfield units, which scenes of files read; with their option `crop:
    none` the volume keeps its position. Other units are unchanged.

    Raises:
        ImportError: nibabel is not installed.
    """
    save_nifti(case / "truth.nii.gz", hounsfield(volume) if unit == "1/mm" else volume, grid)
    if mu is not None:
        save_nifti(case / MU_FILE, mu, grid)


def save_placement(case: Path, placement: Float[Tensor, "4 4"]) -> None:
    """Write a case's position as `placement.json`: the affine map in mm from the file's world to
    the rig's, and its last column, the shift.
    """
    record = {"file_to_rig": placement.tolist(), "shift_mm": placement[:3, 3].tolist()}
    write_text(case / "placement.json", json.dumps(record, indent=1) + "\n")


def save_greys(case: Path, views: Float[Tensor, "m v u"]) -> None:
    """Write the views of a case as a detector's grey values in `projections`: 16-bit TIFF with
    dark and flat field.

    Convention: RTK's; the first row is the lowest one, opposite to `views`. Images of an earlier
    run are replaced one by one, so that each is whole at any time; other files stay.

    Args:
        case: folder of the case.
        views: line integrals of attenuation.

    Raises:
        ValueError: integrals beyond the range of 16 bits, as of another unit than 1/mm.
    """
    check_greys(views)
    path = case / "projections"
    earlier = {image.name for image in path.glob("view_*.tif")}
    part = path.with_name(f".projections.{os.getpid()}{PART_ENDING}") if earlier else path
    write_projections(part, views.flip(-2), Exposure(photons=None))
    if earlier:
        for image in part.iterdir():
            os.replace(image, path / image.name)
            earlier.discard(image.name)
        part.rmdir()
        for name in earlier:  # of a rig with more views
            (path / name).unlink()


def check_greys(views: Float[Tensor, "*m v u"]) -> None:
    """Raise ValueError for views that `save_greys` refuses."""
    if not (top := views.max().item()) < MAX_LINE_INTEGRAL:
        raise ValueError(
            f"Expected line integrals of attenuation below {MAX_LINE_INTEGRAL:g} for 16-bit "
            f"images, got {top:.3g}; scene.value=0.02 is near water, in 1/mm"
        )


def file_name(name: str) -> str:
    """The folder name for a case's name."""
    return re.sub(r"[^\w.-]+", "_", name)


def numbered(name: str, earlier: Iterable[Path]) -> str:
    """The name of a case, with _2, _3 ... if its folder would be that of an earlier one, as of
    "a b" after "a_b", or of patients of one name from two sites.
    """
    taken = {folder.name for folder in earlier}
    names = (f"{name}_{number}" if number > 1 else name for number in count(1))
    return next(one for one in names if file_name(one) not in taken)
