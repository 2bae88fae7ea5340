"""ASTRA's vector geometries ("cone_vec", "parallel3d_vec"), as text or .npy."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mvrecon.core.files.checks import Refused, file_errors, npy_array
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.convert import from_astra, to_astra
from mvrecon.geometry.cameras.formats import common
from mvrecon.geometry.cameras.rigs import Detector


def read(
    path: str | Path,
    pixels: Any,
    parallel: bool = False,
    unit_mm: float = 1.0,
    world: str = "RAS",
    flip_rows: bool = True,
) -> Cameras:
    """Rig in mm from ASTRA's twelve numbers per view: source (or ray), detector's centre, u, v.

    Args:
        path: text, twelve numbers per line, or a .npy of [views 12].
        pixels: rows and columns of the detector.
        parallel: "parallel3d_vec": the first three numbers are the ray's direction, of either sign.
        unit_mm: length of ASTRA's unit in mm.
        world: axes of the file, "RAS", "LPS" or "IEC"; see `to_ras`.
        flip_rows: v runs upwards, as in ASTRA's own circular geometries; the rows of the views must
            be reversed.

    Convention: ASTRA's data are [rows views columns]: views [m v u] are their transpose.

    Warns:
        UserWarning: cone beams whose sources are unit vectors, as the rays of parallel beams are.

    Raises:
        OSError: the file cannot be read.
        ValueError: an invalid file, non-finite values, left-handed cone beams: v runs the other way
            than `flip_rows` states, or options that contradict the first line that `write` wrote.
    """
    shape = Detector(pixels, 1.0).pixels  # type: ignore[arg-type]
    vectors = (
        _npy(Path(path))
        if str(path).endswith(".npy")
        else common.rows_of(path, common.number_lines(path), 12)
    )
    if not str(path).endswith(".npy"):
        common.check_head(path, _head(shape, parallel, unit_mm, world))
    if not parallel and ((vectors[:, :3].norm(dim=-1) - 1).abs() < 1e-6).all():
        warnings.warn(
            f"{path}: sources of cone beams are {unit_mm:g} mm from the origin; if they are rays "
            f"of parallel beams, set parallel=true",
            stacklevel=2,
        )
    with file_errors(path, "is no rig", f"it was read with flip_rows={str(flip_rows).lower()}"):
        if not 0 < unit_mm < float("inf"):
            raise ValueError(f"expected unit_mm as positive mm, got {unit_mm}")
        cameras = from_astra(vectors * unit_mm, shape, parallel, flip_rows=flip_rows)
        return common.from_world(cameras, world)


def _npy(path: Path) -> torch.Tensor:
    """Vectors of a .npy file, whose shape is checked before they are read."""
    array = npy_array(path)
    if array.dtype.kind != "f" or array.shape[1:] != (12,) or not 0 < len(array) <= common.VIEWS:
        raise Refused(f"{path}: expected floating [views 12], got {array.dtype} {array.shape}")
    return torch.from_numpy(array.astype(np.float64))


def write(cameras: Cameras, path: str | Path, world: str = "RAS", flip_rows: bool = True) -> None:
    """Write a rig as text, twelve numbers in mm per view, for `read` with the same options.

    Args:
        cameras: cone beams ("cone_vec") or parallel beams ("parallel3d_vec").
        path: path of the text file.
        world: axes of the file.
        flip_rows: v upwards; the rows of the views must be reversed for ASTRA.

    Raises:
        OSError: the file cannot be written.
        ValueError: pinholes, whose rays ASTRA would begin on the detector's other side, and cone
            beams without a source or parallel beams with one.
    """
    if cameras.extent != ("line" if cameras.parallel else "segment"):
        raise ValueError(
            f"expected X-ray cone beams (extent 'segment') or parallel beams (extent 'line') for "
            f"ASTRA, got {'parallel' if cameras.parallel else 'cone'} beams with "
            f"{cameras.extent!r}"
        )
    vectors = to_astra(common.into_world(cameras, world))
    if flip_rows:
        vectors = torch.cat([vectors[:, :9], -vectors[:, 9:]], dim=1)
    head = _head(cameras.shape, cameras.parallel, 1.0, world)
    common.save_lines(path, head, vectors.tolist(), " ")


def _head(shape: Sequence[int], parallel: bool, unit_mm: float, world: str) -> str:
    """The first line of a file that `write` writes."""
    kind, unit = "parallel3d_vec" if parallel else "cone_vec", f"{unit_mm:g} mm".removeprefix("1 ")
    return f"# ASTRA {kind}, {unit} ({world}), {shape[0]} rows, {shape[1]} columns"
