"""Draws the wide picture of the README: python scripts/docs/teaser.py RUN_FOLDER OUT.png pt_206

The rig, the measured views, and one plane of the case by each method, all from the same views,
beside the truth. The run is a training of `cross_view` whose test cases
include the named one; the PSNR of the whole volume stands below each panel.
"""

import argparse
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib
import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.data.dataset import Batch, single_cases
from mvrecon.data.module import SceneData
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz.rig import outlines
from mvrecon.training.fit import build_data
from mvrecon.training.run_folder import read_settings
from mvrecon.training.trained import Trained

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

#: Attenuation in 1/mm at the white end of the scale: twice water's, bone's.
WHITE = 0.04
#: Weight of total variation, chosen on aligned test cases of study 21.
TV_WEIGHT = 6e-4


def volumes(case: Batch, A: mv.Drr, network: Trained) -> dict[str, Tensor]:
    """The case by each method, from its measured views [1 1 m v u]."""
    y = case["views"]
    return {
        "FDK": mv.fdk(A, y),
        "FISTA-TV": mv.fista_tv(A, y, weight=TV_WEIGHT),
        "robust SIRT": mv.robust_sirt(A, y),
        "cross-view network": network.module(y, network.module.operator(case)).volume,
    }


def rig(axes: Axes, data: SceneData) -> None:
    """The cameras around the grid, from above."""
    corners, starts = outlines(data.cameras)
    for outline, source in zip(corners, starts, strict=True):
        axes.plot(*outline[:2, :2].T, color="#7896c8", linewidth=1.5)
        axes.plot(*source[0, :2], "o", color="#202020", markersize=4)
        axes.plot(*torch.stack([source[0, :2], source[0, :2] / -2]).T, color="#cccccc", zorder=0)
    low, high = data.grid.corners().aminmax(dim=0)
    (x, y), (width, depth) = low[:2].tolist(), (high - low)[:2].tolist()
    axes.add_patch(Rectangle((x, y), width, depth, facecolor="#006e3c"))
    axes.set_aspect("equal")
    axes.set_title("rig from above")
    axes.set_axis_off()


def drawn(case: Batch, data: SceneData, network: Trained) -> Figure:
    """Rig, views and planes; disturbed views have a red frame."""
    A, truth = mv.Drr(data.grid, data.cameras), case["volume"]
    shown = volumes(case, A, network) | {"truth": truth}
    views, wrong = case["views"][0, 0], case["wrong"][0].tolist()
    figure = plt.figure(figsize=(13, 2.9))
    parts: Any = figure.subfigures(1, 3, width_ratios=(1.6, 1.5, 6.5))
    left, middle, right = parts
    rig(left.add_axes((0.05, 0.08, 0.9, 0.76)), data)
    middle.suptitle(f"{len(views)} views", size=matplotlib.rcParams["axes.titlesize"], y=0.97)
    tiles = middle.subplots(4, 2, gridspec_kw={"wspace": 0.08, "hspace": 0.08})
    middle.subplots_adjust(left=0.02, right=0.98, bottom=0.08, top=0.88)
    for axis, view, bad in zip(tiles.flat, views, wrong, strict=True):
        axis.imshow(view, "gray_r", vmin=0, vmax=float(views.quantile(0.999)), aspect="auto")
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set(color="tab:red" if bad else "#cccccc", linewidth=2 if bad else 1)
    panels = right.subplots(1, len(shown), gridspec_kw={"wspace": 0.04})
    right.subplots_adjust(left=0.02, right=0.995, bottom=0.08, top=0.88)
    for axis, (name, volume) in zip(panels, shown.items(), strict=True):
        plane = volume[0, 0, ..., truth.shape[-1] // 2]
        shades: dict[str, Any] = {"vmin": 0, "vmax": WHITE, "interpolation": "bicubic"}
        axis.imshow(plane, "gray", origin="lower", **shades)
        axis.set(title=name, xticks=[], yticks=[])
        axis.set_aspect(data.grid.spacing[2] / data.grid.spacing[1])
        if volume is not truth:
            figures = volume_metrics(volume[0], truth[0], case["inside"][0], data.data_range)
            axis.set_xlabel(f"{figures['psnr']:.1f} dB", size="large")
    return figure


@torch.no_grad()
def main() -> None:
    """Find the case among the run's test cases and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run of cross_view")
    parser.add_argument("out", type=Path, help="picture to write")
    parser.add_argument("case", help="name of a test case")
    given = parser.parse_args()
    data = build_data(read_settings(given.run))
    data.setup("test")
    tests = chain.from_iterable(map(single_cases, data.test_dataloader()))
    case = next(case for case in tests if case["name"][0] == given.case)
    drawn(case, data, mv.load(given.run)).savefig(given.out, dpi=110)


if __name__ == "__main__":
    main()
