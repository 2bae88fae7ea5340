"""Make mvrecon's volume files from a clone of the OpenKBP data
(https://github.com/ababier/open-kbp, MIT licence).

    git clone https://github.com/ababier/open-kbp
    python scripts/data/prepare_openkbp.py open-kbp --out data

writes data/openkbp_train.h5 (200 patients), openkbp_val.h5 (40) and openkbp_test.h5 (100):
head-neck CT of 128^3 voxels, with organs and targets as labels; `mvrecon/data/hdf5.py` tells the
layout. In the clone a volume is a table of flat indices into (y, x, z) and values; what is not
listed is 0; HU are the values - 1024.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from mvrecon.data.hdf5 import Stored, write_volumes

SETS = {"train": "train-pats", "val": "validation-pats", "test": "test-pats"}
SHAPE = (128, 128, 128)
LOWEST, HIGHEST = -1024, 3071
#: In the order of their labels, 1 to 10; where structures overlap, the later one counts.
STRUCTURES = (
    *("Brainstem", "SpinalCord", "RightParotid", "LeftParotid", "Esophagus", "Larynx", "Mandible"),
    *("PTV56", "PTV63", "PTV70"),
)
ATTRIBUTES = {
    "labels": ",".join(f"{k}={name}" for k, name in enumerate(STRUCTURES, start=1)),
    "orientation": "LPI",
    "source": "OpenKBP head-neck CT (github.com/ababier/open-kbp), MIT licence; metal cut to 3071 "
    "HU",
}


def table(path: Path, columns: int) -> np.ndarray:
    """The first columns of a table [rows columns] under one line of headings.

    Raises:
        ValueError: not such a table, or an index outside of the volume.
    """
    lines = path.read_text().splitlines()[1:]
    try:
        rows = np.array([line.split(",")[:columns] for line in lines], dtype=float).reshape(
            -1, columns
        )
    except ValueError as error:
        raise ValueError(
            f"{path}: expected lines 'index,value' under one heading ({error})"
        ) from error
    index = rows[:, 0]
    if len(rows) and not ((index >= 0) & (index < np.prod(SHAPE)) & (index % 1 == 0)).all():
        raise ValueError(
            f"{path}: expected indices from 0 to {np.prod(SHAPE) - 1}, got {index.min()} to "
            f"{index.max()}"
        )
    return rows


def filled(rows: np.ndarray, values: np.ndarray | int) -> np.ndarray:
    """A volume (z, y, x) with values at flat indices into (y, x, z), and zeros elsewhere."""
    volume = np.zeros(np.prod(SHAPE))
    volume[rows[:, 0].astype(np.int64)] = values
    return volume.reshape(SHAPE).transpose(2, 0, 1)


def patient(folder: Path) -> Stored:
    """One patient of the clone.

    Raises:
        ValueError: tables that do not read as expected.
        FileNotFoundError: a table is missing.
    """
    ct = table(folder / "ct.csv", 2)
    hu = np.clip(np.rint(filled(ct, ct[:, 1])) + LOWEST, LOWEST, HIGHEST).astype(np.int16)
    label = np.zeros(hu.shape, np.uint8)
    for value, name in enumerate(STRUCTURES, start=1):
        if (file := folder / f"{name}.csv").exists():
            label[filled(table(file, 1), 1) > 0] = value
    spacing = np.loadtxt(folder / "voxel_dimensions.csv", ndmin=1)
    if spacing.shape != (3,) or not (spacing > 0).all():
        raise ValueError(
            f"{folder / 'voxel_dimensions.csv'}: expected three positive mm, got {spacing.tolist()}"
        )
    y, x, z = spacing.round(3).tolist()
    return Stored(folder.name, hu, (z, y, x), label)


def patients(folders: list[Path], title: str) -> Iterator[Stored]:
    """The patients of several folders, with a progress bar."""
    for folder in track(folders, title):
        yield patient(folder)


def prepare(clone: Path, out: Path, skip: bool = False) -> dict[Path, int]:
    """Write every set that the clone has; returns the files and how many patients each holds.

    Args:
        clone: its folder.
        out: where the files go.
        skip: leave out patients without a `ct.csv`.

    Raises:
        FileNotFoundError: the clone has no patients, or, without `skip`, some that lack a `ct.csv`;
            nothing is written.
    """
    folders = {
        name: sorted_patients(clone / "provided-data" / folder) for name, folder in SETS.items()
    }
    empty = [p for group in folders.values() for p in group if not (p / "ct.csv").is_file()]
    if empty and not skip:
        names = ", ".join(f"{p.parent.name}/{p.name}" for p in empty)
        raise FileNotFoundError(
            f"{clone}: {len(empty)} patient(s) without ct.csv: {names}; --skip leaves them out"
        )
    written = {}
    for name, group in folders.items():
        if whole := [p for p in group if p not in empty]:
            path = out / f"openkbp_{name}.h5"
            written[path] = write_volumes(path, patients(whole, path.name), **ATTRIBUTES)
    if not written:
        raise FileNotFoundError(
            f"{clone}: expected a clone with provided-data/{SETS['train']}/pt_*/ct.csv, found none"
        )
    return written


def sorted_patients(folder: Path) -> list[Path]:
    """The patients' folders of a set, by their numbers."""
    return sorted(folder.glob("pt_*"), key=lambda p: int(re.sub(r"\D", "", p.name)))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description="Make volume files from a clone of ababier/open-kbp."
    )
    parser.add_argument("clone", type=Path, help="folder of the clone")
    parser.add_argument("--out", type=Path, default=Path("data"), help="where the files go (data)")
    parser.add_argument("--skip", action="store_true", help="leave out patients without ct.csv")
    options = parser.parse_args()
    try:
        written = prepare(options.clone, options.out, options.skip)
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    for path, count in written.items():
        Console().print(f"{path}: {count} patients")


if __name__ == "__main__":
    main()
