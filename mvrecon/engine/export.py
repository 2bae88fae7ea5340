"""A case as files: volumes as NIfTI, views and planes as images, measured views as HDF5."""

import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
from jaxtyping import Float
from torch import Tensor

from mvrecon.data.nifti import save_nifti
from mvrecon.files.atomic import written_whole
from mvrecon.geometry.grid import Grid
from mvrecon.viz import montage
from mvrecon.viz.planes import Image


def save_case(
    folder: Path,
    scene: Mapping[str, Any],
    volumes: Mapping[str, Tensor],
    grid: Grid,
    data_range: float,
) -> Path:
    """Write one scene: `views.png`, `planes.png`, and with nibabel `truth.nii.gz` and one for each
    method.

    Returns the scene's own folder in `folder`.
    """
    case = folder / _file_name(scene["name"][0])
    truth = scene["volume"][0, 0]
    shown = {label: volume[0, 0] for label, volume in volumes.items()}
    save_png(case / "views.png", montage.gallery(scene["views"][0, 0]))
    save_png(case / "planes.png", montage.planes(truth, shown, data_range, grid.spacing))
    if find_spec("nibabel"):
        for label, volume in {"truth": truth, **shown}.items():
            save_nifti(case / f"{label}.nii.gz", volume, grid)
    return case


def save_views(folder: Path, name: str, views: Float[Tensor, "m v u"], unit: str) -> Path:
    """Write the views of one case: `view_<camera>.png` as radiographs, black at 0, and the numbers
    as `views.h5`.

    `views.h5` holds `views` [m v u], float32, with the attributes `axes` and `unit`, and the case's
    `name`.

    Args:
        folder: of all cases.
        name: of the case, and of its own folder in `folder`, which is returned.
        views: line integrals.
        unit: of the line integrals.
    """
    case = folder / _file_name(name)
    for m, image in enumerate(montage.radiographs(views)):
        save_png(case / f"view_{m:03d}.png", image)
    with written_whole(case / "views.h5") as part, h5py.File(part, "w") as file:
        file.attrs["name"] = name
        values = views.detach().cpu().float().numpy()
        dataset = file.create_dataset("views", data=values, compression="gzip", shuffle=True)
        dataset.attrs.update(axes="camera, v, u", unit=unit)
    return case


def save_png(path: Path, image: Image) -> None:
    """Write an image; a file of that name is replaced whole or not at all."""
    from PIL import Image as Pillow

    with written_whole(path) as part:
        Pillow.fromarray(image).save(part, format="PNG")


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)
