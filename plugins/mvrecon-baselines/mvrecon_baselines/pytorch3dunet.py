"""HDF5 files of pytorch-3dunet: `raw` [z y x] or [c z y x], and `label` of the same voxels.

The layout follows the project's README (github.com/wolny/pytorch-3dunet): axes z, y, x, channels
first; the file does not contain the spacing.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mvrecon.core.files.checks import VOLUME, Refused, check_file
from mvrecon.data.storage import check_attributes, check_chunks, dataset_in, opened, written

EXPECTED = "a file of pytorch-3dunet: HDF5 with raw [z y x] or [c z y x], and optionally label"
#: Axes of one volume, and of several channels.
AXES = (3, 4)


class Example(NamedTuple):
    """One training volume.

    Args:
        raw: values [d h w] or [c d h w].
        label: target of the same voxels, [d h w] or [c d h w]; None for prediction.
    """

    raw: np.ndarray
    label: np.ndarray | None = None


def read_example(path: str | Path) -> Example:
    """Read values and labels of a pytorch-3dunet file, in their stored dtype.

    Raises:
        FileNotFoundError: the file does not exist.
        Refused: not HDF5, another layout, a damaged file, or values and labels of different voxels.
    """
    path = Path(path).expanduser()
    check_file(path, EXPECTED)
    with opened(path, EXPECTED) as file:
        arrays = {}
        check_attributes(path, file)
        for name in ("raw", "label"):
            if name == "raw" or name in file:
                dataset = dataset_in(path, file, name, EXPECTED)
                if dataset.nbytes > VOLUME:
                    raise Refused(
                        f"{path}: expected {name!r} of at most {VOLUME} bytes, got {dataset.nbytes}"
                    )
                check_attributes(path, dataset)
                check_chunks(path, dataset)
                arrays[name] = dataset[:]
    return _checked(path, Example(arrays["raw"], arrays.get("label")))


def write_example(path: str | Path, example: Example) -> None:
    """Write a compressed file for pytorch-3dunet, atomically.

    Raises:
        Refused: wrong axes, or values and labels of different voxels.
    """
    _checked(path, example)
    with written(Path(path)) as file:
        for name, values in example._asdict().items():
            if values is not None:
                file.create_dataset(name, data=values, compression="gzip", shuffle=True)


def _checked(path: str | Path, example: Example) -> Example:
    for name, values in example._asdict().items():
        if values is not None and (values.ndim not in AXES or values.dtype.kind not in "iuf"):
            raise Refused(f"{path}: has {name!r} as {values.dtype} {values.shape}; {EXPECTED}")
    raw, label = example
    if label is not None and label.shape[-3:] != raw.shape[-3:]:
        raise Refused(
            f"{path}: expected labels of the voxels {raw.shape[-3:]} of raw, got {label.shape[-3:]}"
        )
    return example
