"""Draws pictures of the pages from test cases of a trained run of `cross_view`:

    python scripts/docs/run_pictures.py alignment RUN_FOLDER OUT.png pt_206
    python scripts/docs/run_pictures.py weights RUN_FOLDER OUT.png pt_206 pt_210 pt_213
    python scripts/docs/run_pictures.py board RUN_FOLDER OUT.png pt_210
    python scripts/docs/run_pictures.py teaser RUN_FOLDER OUT.png pt_206

`alignment`: SIRT of the views as measured and of the aligned views, beside the truth, and the
shifts that alignment estimates. `weights`: how much each camera counts in a network that compares
views. `board`: the card `cameras` of TensorBoard. `teaser`: the wide picture of the README, the
rig, the measured views, and one plane by each method, all from the same views, beside the truth;
the PSNR of the whole volume stands below each panel.
"""

import argparse
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

import mvrecon as mv
from mvrecon.data.acquisition.disturbances import RigErrors
from mvrecon.data.dataset import Batch, single_cases
from mvrecon.data.module import SceneData
from mvrecon.methods.calibration.self_alignment import self_aligned
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz.images import save_png
from mvrecon.report.viz.review import alignments
from mvrecon.report.viz.rig import outlines
from mvrecon.training.fit import build_data
from mvrecon.training.run_folder import read_settings
from mvrecon.training.trained import Trained

#: Attenuation in 1/mm at the white end of the scale: twice water's, bone's.
WHITE = 0.04
#: Weight of total variation, chosen on aligned test cases of study 21.
TV_WEIGHT = 6e-4


def alignment(data: SceneData, case: Batch) -> Figure:
    """The sagittal plane of each volume, and the shift of each camera."""
    A, truth = mv.Drr(data.grid, data.cameras), case["volume"]
    aligned, by = self_aligned(A, case["views"])
    assert by is not None
    views = {"SIRT, views as measured": case["views"], "SIRT, aligned views": aligned}
    volumes = {name: mv.sirt(A, y, 25, momentum=True) for name, y in views.items()}
    figure = plt.figure(figsize=(8, 4.8), layout="constrained")
    axes = list(figure.subplot_mosaic("ABC;DDD", height_ratios=(3, 2)).values())
    for axis, (name, volume) in zip(axes, {**volumes, "truth": truth}.items(), strict=False):
        plane = volume[0, 0, ..., truth.shape[-1] // 2]
        edges = [n * step / 2 for n, step in zip(data.grid.size, data.grid.spacing, strict=True)]
        extent = (-edges[1], edges[1], -edges[2], edges[2])
        shades: dict[str, Any] = {"vmin": 0, "vmax": data.data_range, "extent": extent}
        grey = axis.imshow(plane, "gray", origin="lower", **shades)
        if volume is not truth:
            figures = volume_metrics(volume[0], truth[0], case["inside"][0], data.data_range)
            name += f"\n{figures['psnr']:.1f} dB"
        axis.set(title=name, xlabel="y / mm")
    axes[0].set_ylabel("z / mm")
    figure.colorbar(grey, ax=axes[:3], label="attenuation (1/mm)")
    lost = torch.nonzero(by.gain[0] == 0)[:, 0]
    moved = RigErrors.of(case).image_shift(data.cameras, truth[0, 0], data.grid)
    found, true = by.shift_px[0].norm(dim=-1), moved.norm(dim=-1)
    bars(axes[3], found, case["wrong"][0], "shift of the image (pixels)")
    axes[3].plot(true, "k_", markersize=13, label="truth: shift, tilt and motion")
    for camera in lost.tolist():
        axes[3].text(camera, 0.1, "lost", rotation=90, ha="center")
    axes[3].legend()
    return figure


def weights(network: Trained, cases: list[Batch]) -> Figure:
    """The weight of each camera in each case."""
    shape = {"figsize": (3.0 * len(cases), 2.6), "sharey": True, "squeeze": False}
    figure, axes = plt.subplots(1, len(cases), layout="constrained", **shape)
    for axis, case in zip(axes[0], cases, strict=True):
        A = network.module.operator(case)
        found = network.module(case["views"], A).camera_weights
        bars(axis, found[0], case["wrong"][0], "weight")
        axis.axhline(1 / found.shape[1], color="black", linestyle=":", label="equal weights")
        axis.set_title(case["name"][0])
        axis.label_outer()
    axes[0, 0].legend()
    return figure


def bars(axis: Axes, values: Tensor, wrong: Tensor, name: str) -> None:
    """A bar for each camera, red where it is faulty."""
    colours = ["tab:red" if bad else "tab:gray" for bad in wrong.tolist()]
    axis.bar(range(len(values)), values.tolist(), color=colours)
    axis.set(xlabel="camera (red: misaligned)", ylabel=name, xticks=range(len(values)))


def by_method(case: Batch, A: mv.Drr, network: Trained) -> dict[str, Tensor]:
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


def teaser(case: Batch, data: SceneData, network: Trained) -> Figure:
    """Rig, views and planes; disturbed views have a red frame."""
    A, truth = mv.Drr(data.grid, data.cameras), case["volume"]
    shown = by_method(case, A, network) | {"truth": truth}
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
    """Find the cases among the run's test cases and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=["alignment", "board", "teaser", "weights"])
    parser.add_argument("run", type=Path, help="folder of a run with disturbed views")
    parser.add_argument("out", type=Path, help="picture to write")
    parser.add_argument("cases", nargs="+", help="names of test cases; one but for `weights`")
    given = parser.parse_args()
    data = build_data(read_settings(given.run))
    data.setup("test")
    tests = chain.from_iterable(map(single_cases, data.test_dataloader()))
    known = {case["name"][0]: case for case in tests}
    cases = [known[name] for name in given.cases]
    if given.picture == "board":
        _, by = self_aligned(mv.Drr(data.grid, data.cameras), cases[0]["views"])
        true = RigErrors.of(cases[0]).image_shift(data.cameras, cases[0]["volume"][0, 0], data.grid)
        return save_png(given.out, alignments(by.shift_px[0], by.gain[0], true))
    if given.picture == "alignment":
        figure = alignment(data, cases[0])
    elif given.picture == "teaser":
        figure = teaser(cases[0], data, mv.load(given.run))
    else:
        figure = weights(mv.load(given.run), cases)
    figure.savefig(given.out, dpi=110)


if __name__ == "__main__":
    main()
