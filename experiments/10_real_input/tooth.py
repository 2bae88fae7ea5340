"""TomoPy's example scan of a tooth as files that `mvrecon-reconstruct` reads: views, dark and flat
field as NumPy arrays of grey values; and the picture of its volumes.

    python experiments/10_real_input/tooth.py read tooth.h5 FOLDER
    python experiments/10_real_input/tooth.py draw RIGHT.nii.gz WRONG.nii.gz OUT.png

The file is in the layout of Data Exchange (De Carlo and others, J. Synchrotron Rad. 21, 2014).
"""

import sys
from pathlib import Path

import h5py
import numpy as np
from matplotlib.figure import Figure

import mvrecon as mv

FIELDS = {"views": "data", "flat": "data_white", "dark": "data_dark"}


def read(scan: Path, folder: Path) -> None:
    """Write the arrays of the scan."""
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(scan) as file:
        for name, field in FIELDS.items():
            np.save(folder / f"{name}.npy", file[f"exchange/{field}"][:])


def draw(right: Path, wrong: Path, out: Path) -> None:
    """The first plane of both volumes, white at the 99.9th percentile of the correct one."""
    named = {"correct offset of the axis": right, "wrong sign of the offset": wrong}
    volumes = {name: mv.read_volume(file)[0] for name, file in named.items()}
    top = np.percentile(volumes["correct offset of the axis"], 99.9)
    figure = Figure(figsize=(7.5, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (name, volume) in zip(axes, volumes.items(), strict=True):
        shown = axis.imshow(volume[0], cmap="gray", vmin=0, vmax=top)
        axis.set(title=name, xlabel="x / pixels")
    axes[0].set_ylabel("y / pixels")
    figure.colorbar(shown, ax=axes, label="attenuation (1/pixel)")
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    {"read": read, "draw": draw}[sys.argv[1]](*map(Path, sys.argv[2:]))
