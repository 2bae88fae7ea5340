"""Draws the steps of the cross-view model:
python scripts/docs/model_diagram.py docs/images/model.svg
"""

import sys

from matplotlib import pyplot as plt
from matplotlib.patches import FancyBboxPatch

plt.rcParams["svg.fonttype"] = "none"  # text stays text

CAMERA, VOLUME, DATA = "#d7e8f7", "#fbe6cf", "#eeeeee"
#: Middle (x, y), text, colour, and copies: one for each camera, drawn as three.
BOXES = {
    "views": ((0, 2), "views y", DATA, 3),
    "start": ((0, 1), "SIRT start x,\ndirection d", VOLUME, 1),
    "depth": ((1, 2), "depth 3-D U-Net\nin each frustum", CAMERA, 3),
    "head": ((2, 2), "head: density\nalong each ray", CAMERA, 3),
    "estimates": ((3, 2), "inverse projection:\nper-view estimates", CAMERA, 3),
    "predictions": ((4, 2), "re-projection:\neach view by the others", CAMERA, 3),
    "weights": ((4, 1), "weighting 3-D U-Net,\nsoftmax over cameras", CAMERA, 3),
    "fused": ((3, 1), "weighted fusion", VOLUME, 1),
    "rays": ((4, 0), "ray weights; 2-D U-Net\non view and residual", CAMERA, 3),
    "reweighted": ((3, 0), "SIRT from x\nwith ray weights", VOLUME, 1),
    "volume": ((2, 1), "volume 3-D U-Net on\nx, d, fused estimates", VOLUME, 1),
    "steps": ((1, 1), "data consistency\nwith ray weights", VOLUME, 1),
    "result": ((1, 0), "volume", DATA, 1),
}
ARROWS = (
    "views start, views depth, start depth, depth head, head estimates, estimates predictions, "
    "predictions weights, estimates fused, weights fused, fused volume, weights rays, "
    "rays reweighted, reweighted volume, volume steps, steps result"
)
#: Of a box, in inches, and between the middles of neighbours.
WIDTH, HEIGHT, ACROSS, DOWN = 1.75, 0.62, 2.2, 1.15


def main() -> None:
    """Write the picture to the path given."""
    figure, axes = plt.subplots(figsize=(11, 3.4), layout="constrained")
    patches = {}
    for name, ((column, row), text, colour, copies) in BOXES.items():
        x, y = column * ACROSS, row * DOWN
        for shift in (0.07 * n for n in reversed(range(copies))):
            corner = (x - WIDTH / 2 + shift, y - HEIGHT / 2 + shift)
            box = FancyBboxPatch(corner, WIDTH, HEIGHT, "round,pad=0.03", facecolor=colour)
            patches[name] = axes.add_patch(box)
        axes.text(x, y, text, ha="center", va="center", fontsize=8.5)
    for start, end in (arrow.split() for arrow in ARROWS.split(", ")):
        (x0, y0), (x1, y1) = (
            (BOXES[name][0][0] * ACROSS, BOXES[name][0][1] * DOWN) for name in (start, end)
        )
        style = {"arrowstyle": "-|>", "shrinkA": 2, "shrinkB": 4, "color": "#444444"}
        style |= {"patchA": patches[start], "patchB": patches[end]}
        axes.annotate("", (x1, y1), (x0, y0), arrowprops=style)
    axes.set(xlim=(-1.1, 4 * ACROSS + 1.1), ylim=(-0.5, 2 * DOWN + 0.6), aspect="equal")
    axes.axis("off")
    figure.savefig(sys.argv[1])


if __name__ == "__main__":
    main()
