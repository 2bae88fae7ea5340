"""TomoPy's example scan of a tooth as files that `mvrecon-reconstruct` reads: views, dark and flat
field as NumPy arrays of grey values.

    python experiments/10_real_input/tooth.py tooth.h5 FOLDER

The file is in the layout of Data Exchange (De Carlo and others, J. Synchrotron Rad. 21, 2014).
"""

import sys
from pathlib import Path

import h5py
import numpy as np

FIELDS = {"views": "data", "flat": "data_white", "dark": "data_dark"}


def main(scan: Path, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(scan) as file:
        for name, field in FIELDS.items():
            np.save(folder / f"{name}.npy", file[f"exchange/{field}"][:])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
