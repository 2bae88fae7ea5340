"""Measured scans by mvrecon and by a filtered back-projection in NumPy, and a simulated scan with
unequal pixels: `python study.py NEUTRON.tif SCAN.nxs OUT`, with the commands' volumes in OUT.
"""

import json
import sys
from pathlib import Path

import numpy as np
import tifffile
import torch
from matplotlib import pyplot as plt

import mvrecon as mv
from mvrecon.apps.rig_checks import FINAL_ITERATIONS, SomeViews, coarse_grid
from mvrecon.apps.scan import Scan
from mvrecon.core.files.runs import write_rows
from mvrecon.data.projections.rings import without_rings
from mvrecon.data.projections.views import Measured, MeasuredViews
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.field import auto_grid

HERE = Path(__file__).parent
#: Grey value without an object, pixel size in mm, and the columns by which the axis is left of the
#: middle.
FLAT, PITCH, AXIS = 46811, 0.05, 6.05
#: Cylinders of the simulated scan: centre (x, y) and radius in pixels, attenuation of a pixel.
CYLINDERS = [(10, -8, 90, 0.008), (40, 25, 15, 0.02), (-50, 10, 3, 0.1), (0, -60, 6, 0.05)]
#: Titles of panels by the correction.
SHOWN = {
    "as_is": "as measured",
    "found": "bad columns interpolated",
    "gains": "rings=gains",
    "sorting": "rings=sorting",
}


def fbp(sinogram, degrees, axis, size, pitch):
    """Slice [y x] of a sinogram [m u] of parallel beams over half or full turns, about the column
    `axis`: ramp filter as the exact kernel (Kak and Slaney 1988, eq. 3.61), linear interpolation.
    """
    views, columns = sinogram.shape
    n = 1 << (2 * columns - 1).bit_length()
    k = np.fft.fftfreq(n, 1 / n).round()
    kernel = np.where(k == 0, 0.25, np.where(k % 2 == 1, -1 / (np.pi * np.where(k, k, 1)) ** 2, 0))
    padded = np.fft.fft(sinogram, n, axis=1) * np.fft.fft(kernel)
    filtered = np.fft.ifft(padded, axis=1).real[:, :columns] / pitch
    y, x = (np.mgrid[:size, :size] - (size - 1) / 2).reshape(2, -1)
    out = np.zeros(size * size)
    for view, a in zip(filtered, np.radians(degrees), strict=True):
        out += np.interp(axis + y * np.cos(a) - x * np.sin(a), np.arange(columns), view)
    return (out * np.pi / views).reshape(size, size)


def compared(found, expected, inside):
    """Relative difference and correlation of two slices."""
    a, b = found[inside], expected[inside]
    return np.linalg.norm(a - b) / np.linalg.norm(b), np.corrcoef(a, b)[0, 1]


def mirrored(sinogram, some=slice(None)):
    """Column of the axis by views of the first half turn, or some of them, and those opposite,
    mirrored: least squares over shifts.
    """
    half = len(sinogram) // 2
    first, second = sinogram[:half][some], sinogram[half : 2 * half, ::-1][some]
    columns = sinogram.shape[1]
    f, edge = np.fft.fftfreq(columns), columns // 12
    tried = np.arange(-columns / 20, columns / 20, 0.05)
    misfit = []
    for c in tried:
        moved = np.fft.ifft(np.fft.fft(second) * np.exp(-4j * np.pi * f * c)).real
        misfit.append(((first - moved)[:, edge:-edge] ** 2).mean())
    i = int(np.argmin(misfit))
    a, b, _ = np.polyfit(tried[i - 2 : i + 3], misfit[i - 2 : i + 3], 2)
    return (columns - 1) / 2 - b / (2 * a)


def neutron(file, out):
    """Differences of the commands' slices of the neutron sinogram and NumPy's, and their rings."""
    grey, angles = tifffile.imread(file), np.linspace(0, 360, 459)
    slices, rows = {}, []
    for name, options in (
        ("as_is", {"find_bad_pixels": False}),
        ("found", {}),
        ("gains", {"rings": "gains"}),
        ("sorting", {"rings": "sorting"}),
    ):
        measured = MeasuredViews(Measured(path=file, layout="sinogram", flat=FLAT, **options))
        sinogram = measured.whole().views[:, 0].double().numpy()
        slices[name] = read_volume(out / f"{name}.nii.gz")[0].double().numpy().squeeze()
        middle = (grey.shape[1] - 1) / 2
        axis = middle - AXIS
        expected = fbp(sinogram[:-1], angles[:-1], axis, len(slices[name]), PITCH)
        y, x = np.mgrid[: len(expected), : len(expected)] - (len(expected) - 1) / 2
        off, correlation = compared(slices[name], expected, np.hypot(x, y) < 220)
        row = {"correction": name, "difference from NumPy": off, "correlation": correlation}
        row["axis by mirrored views"] = middle - mirrored(sinogram)
        rows.append({**row, "rings": rings(slices[name])})
        if name == "found":
            found = json.loads((out / "calibrated" / "results.json").read_text())["calibration"]
            aside = {"calibrate=[offset_u]": found["offset_px"][0][0]}
            aside["mirrored views"] = row["axis by mirrored views"]
            for n, k in enumerate(range(0, 229, 46), 1):
                some = mirrored(sinogram, slice(k, k + 46))
                aside[f"mirrored views, group {n}"] = middle - some
            by = [{"by": name, "columns aside": value} for name, value in aside.items()]
            write_rows(HERE / "axis.csv", by)
    write_rows(HERE / "neutron.csv", rows)
    draw("neutron.png", {SHOWN[name]: x for name, x in slices.items()}, -0.1, 0.8)


def rings(values):
    """Standard deviation of the second differences, along the radius, of a slice's means over
    circles: rings of a pixel's width about the axis.
    """
    y, x = np.mgrid[: len(values), : len(values)] - (len(values) - 1) / 2
    radius = np.hypot(x, y).round().astype(int).ravel()
    near = radius < len(values) / 2
    means = np.bincount(radius[near], values.ravel()[near]) / np.bincount(radius[near])
    return np.diff(means[10 : int(0.45 * len(values))], n=2).std()


def synchrotron(file, out):
    """Difference of the command's slices of the synchrotron scan and NumPy's."""
    volume = read_volume(out / "k11.nii.gz")[0].double().numpy()
    measured = MeasuredViews(Measured(path=file))
    views = measured.whole().views.double().numpy()
    angles, (rows, columns) = np.linspace(0, 180, len(views)), measured.shape
    found, expected = [], []
    for row in range(4, rows - 4):
        sinogram = views[:, row]
        found.append(volume[volume.shape[0] // 2 + rows // 2 - 1 - row])
        expected.append(fbp(sinogram[:-1], angles[:-1], (columns - 1) / 2, volume.shape[1], 1e-3))
    found, expected = np.array(found), np.array(expected)
    y, x = np.mgrid[: found.shape[1], : found.shape[2]] - (found.shape[1] - 1) / 2
    inside = np.broadcast_to(np.hypot(x, y) < columns / 2 - 2, found.shape)
    off, correlation = compared(found, expected, inside)
    row = {"scan": "K11", "difference from NumPy": off, "correlation": correlation}
    write_rows(HERE / "synchrotron.csv", [row])


def unexplained(file):
    """What shifts of the detector in pixels, and ranges of angles in degrees, leave of the coarse,
    blurred views of the synchrotron scan, as sanity checks compare them.
    """
    measured = MeasuredViews(Measured(path=file))
    detector, count = {"pixels": measured.shape, "pixel_mm": 1e-3}, measured.n_views

    def rig(arc=180.06, shift=0.0):
        cameras = mv.parallel(count, detector, arc_degrees=arc)
        return cameras.shifted(torch.tensor([[shift, 0.0]]))

    scan = Scan(measured, rig(), auto_grid(rig()), {"name": "radon"})
    seen = SomeViews.of(scan, coarse_grid(scan))
    rows = []
    for name, values in (("shift", range(-6, 7, 2)), ("arc", (90, 135, 180.06, 225, 270, 360))):
        for value in values:
            cameras = rig(**{name: float(value)})[seen.numbers]
            squares = seen.squares(seen.region.seen_by(cameras), FINAL_ITERATIONS)
            left = squares.sum().sqrt().item()
            rows.append({"change": name, "value": value, "view NRMSE": left})
    write_rows(HERE / "unexplained.csv", rows)


def simulated():
    """Rings of columns whose gains differ by 3 %: cylinders in closed form, 1e5 photons a pixel."""
    rng, columns, views = np.random.default_rng(0), 256, 360
    degrees = np.arange(views) / 2
    a, u = np.radians(degrees)[:, None], np.arange(columns) - (columns - 1) / 2
    y, truth = np.zeros((views, columns)), np.zeros((240, 240))
    place = np.mgrid[:240, :240] - 119.5
    for x0, y0, radius, mu in CYLINDERS:
        s = u - (y0 * np.cos(a) - x0 * np.sin(a))
        y += 2 * mu * np.sqrt(np.clip(radius**2 - s**2, 0, None))
        truth += mu * (np.hypot(place[1] - x0, place[0] - y0) < radius)
    light = rng.poisson(1e5 * np.exp(-y)) / 1e5
    gain, rows, slices = rng.normal(1, 0.03, columns), [], {}
    for scan, values in (("equal", light), ("unequal", light * gain)):
        views_of = torch.from_numpy(-np.log(values)).float()[:, None]
        for rings_by in ("none", "gains", "sorting"):
            fixed = views_of if rings_by == "none" else without_rings(views_of, rings_by, 2)
            found = fbp(fixed[:, 0].double().numpy(), degrees, (columns - 1) / 2, 240, 1.0)
            off = (found - truth)[np.hypot(*place) < 110]
            row = {"pixels": scan, "rings": rings_by, "rms error": np.sqrt((off**2).mean())}
            rows.append({**row, "rings left": rings(found)})
            slices[SHOWN.get(rings_by, "as measured")] = found  # at last of unequal pixels
    write_rows(HERE / "rings.csv", rows)
    draw("rings.png", slices, 0, 0.04, "attenuation (1/pixel)")


def draw(name, slices, low, high, quantity="attenuation (1/mm)"):
    """Slices beside each other, in pixels, on one scale."""
    shape = {"figsize": (2.7 * len(slices) + 0.8, 3.1), "layout": "constrained", "sharey": True}
    figure, panels = plt.subplots(1, len(slices), dpi=100, **shape)
    for panel, (title, values) in zip(panels, slices.items(), strict=True):
        shown = panel.imshow(values, cmap="gray", vmin=low, vmax=high)
        panel.set(title=title, xlabel="x (pixels)")
    panels[0].set_ylabel("y (pixels)")
    figure.colorbar(shown, ax=panels, label=quantity, shrink=0.8)
    figure.savefig(HERE / name)


if __name__ == "__main__":
    simulated()
    neutron(Path(sys.argv[1]), Path(sys.argv[3]))
    synchrotron(Path(sys.argv[2]), Path(sys.argv[3]))
    unexplained(Path(sys.argv[2]))
