"""Draws three methods as they converge: python scripts/docs/animation.py OUT.gif

The README's phantom from its 24 views: one plane and the relative error after each iteration.
"""

import sys
from io import BytesIO
from pathlib import Path

import torch
from matplotlib import pyplot as plt
from PIL import Image
from torch import Tensor

import mvrecon as mv
from mvrecon.methods.classical.solver import Iterate

GRID = mv.Grid.centred(64, spacing=4.0)
CAMERAS = mv.circular(24, 400.0, 800.0, {"pixels": [96, 96], "pixel_mm": 7.0})
WATER = 0.02  # 1/mm
ITERATIONS = 60
#: Shades of grey in the file.
GREYS = 16


def iterates() -> tuple[dict[str, list[Tensor]], Tensor]:
    """The volumes of each method after 1, 2, ... iterations, and the truth."""
    scan = mv.phantom("shepp_logan", GRID, CAMERAS, value=WATER)
    A, y = mv.Drr(GRID, CAMERAS), scan.views[None]
    volumes: dict[str, list[Tensor]] = {"SIRT": [], "SIRT with momentum": [], "FISTA-TV": []}

    def kept(name: str) -> dict:
        def keep(iterate: Iterate) -> bool:
            volumes[name].append(iterate.volume[0, 0].clone())
            return False

        return {"iterations": ITERATIONS, "monitor": keep}

    mv.sirt(A, y, **kept("SIRT"))
    mv.sirt(A, y, momentum=True, **kept("SIRT with momentum"))
    mv.fista_tv(A, y, weight=1e-4, **kept("FISTA-TV"))
    return volumes, scan.volume[0]


def main(out: Path) -> None:
    """Draw the animation."""
    volumes, truth = iterates()
    figure, axes = plt.subplots(1, 3, figsize=(6.4, 2.6), dpi=75, layout="constrained")
    middle = len(truth) // 2
    shades = {"cmap": "gray", "vmin": 0.0, "vmax": 1.5 * WATER, "origin": "lower"}
    images = [axis.imshow(torch.zeros_like(truth[middle]), **shades) for axis in axes]
    for axis in axes:
        axis.set(xticks=[], yticks=[])

    frames = []
    for number in (*range(12), *range(13, ITERATIONS, 4), ITERATIONS - 1):
        for image, axis, (name, states) in zip(images, axes, volumes.items(), strict=True):
            image.set_data(states[number][middle])
            axis.set(title=name, xlabel=f"error {mv.nrmse(states[number], truth):.1%}")
        figure.suptitle(f"24 views, iteration {number + 1}")
        figure.savefig(file := BytesIO(), format="png")
        frames.append(Image.open(file).convert("L").quantize(GREYS, dither=Image.Dither.NONE))
    durations = [150] * (len(frames) - 1) + [3000]  # ms
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=durations, loop=0)


if __name__ == "__main__":
    with torch.inference_mode():
        main(Path(sys.argv[1]))
