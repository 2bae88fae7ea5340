"""Draws the alignment of a test case, or the camera weights of several, from a trained run:

    python scripts/docs/camera_pictures.py alignment RUN_FOLDER OUT.png pt_206
    python scripts/docs/camera_pictures.py weights RUN_FOLDER OUT.png pt_206 pt_210 pt_213
    python scripts/docs/camera_pictures.py board RUN_FOLDER OUT.png pt_210

`alignment`: SIRT of the views as measured and of the aligned views, beside the truth, and the
shifts that alignment estimates. `weights`: how much each camera counts in a network that compares
views. `board`: the card `cameras` of TensorBoard.
"""

import argparse
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib
import torch
from torch import Tensor

import mvrecon as mv
from mvrecon.data.acquisition.disturbances import RigErrors
from mvrecon.data.dataset import Batch, single_cases
from mvrecon.data.module import SceneData
from mvrecon.methods.calibration.self_alignment import self_aligned
from mvrecon.report.metrics import volume_metrics
from mvrecon.report.viz.images import save_png
from mvrecon.report.viz.review import alignments
from mvrecon.training.fit import build_data
from mvrecon.training.run_folder import read_settings
from mvrecon.training.trained import Trained

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure


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
    axis.set(xlabel="camera (red: wrong)", ylabel=name, xticks=range(len(values)))


@torch.no_grad()
def main() -> None:
    """Find the cases among the run's test cases and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=["alignment", "board", "weights"])
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
    else:
        figure = weights(mv.load(given.run), cases)
    figure.savefig(given.out, dpi=110)


if __name__ == "__main__":
    main()
