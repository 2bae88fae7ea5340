"""Draws one plane of a case as several methods reconstruct it, beside the truth:
python scripts/docs/teaser.py EVALUATION... OUT.png --case pt_201 --show sirt=SIRT world_unet=U-Net

The evaluations are folders of `mvrecon-eval save=true`; a method is taken from the first that has
it. The PSNR of the whole volume stands below each panel.
"""

import argparse
import json
from pathlib import Path

import matplotlib

import mvrecon as mv

matplotlib.use("Agg")
from matplotlib import pyplot as plt

#: Attenuation in 1/mm at the white end of the scale: twice water's, bone's.
WHITE = 0.04


def main() -> None:
    """Read the volumes of the case and draw the sagittal plane through the middle of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("evaluations", type=Path, nargs="+", help="folders with results.json")
    parser.add_argument("out", type=Path, help="picture to write")
    parser.add_argument("--case", required=True, help="name of the case")
    parser.add_argument("--show", nargs="+", required=True, help="METHOD=TITLE, from left to right")
    given = parser.parse_args()
    found = {}
    for folder in given.evaluations:
        results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
        at = results["scenes"].index(given.case)
        for method, figures in results["methods"].items():
            found.setdefault(method, (folder / "cases" / given.case, figures["psnr"]["values"][at]))
    panels = []
    for method, title in (entry.split("=", 1) for entry in given.show):
        folder, psnr = found[method]
        panels.append((folder / f"{method}.nii.gz", title, f"{psnr:.1f} dB"))
    panels.append((panels[-1][0].with_name("truth.nii.gz"), "truth", ""))

    size = (1.9 * len(panels) + 0.8, 2.6)
    figure, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained")
    for axis, (path, title, below) in zip(axes, panels, strict=True):
        volume, grid = mv.read_volume(path)
        plane = volume[..., volume.shape[-1] // 2]
        shown = axis.imshow(plane, cmap="gray", origin="lower", vmin=0, vmax=WHITE)
        axis.set(title=title, xlabel=below, xticks=[], yticks=[])
        axis.set_aspect(grid.spacing[2] / grid.spacing[1])
    figure.colorbar(shown, ax=axes, label="attenuation (1/mm)")
    figure.savefig(given.out, dpi=120)


if __name__ == "__main__":
    main()
