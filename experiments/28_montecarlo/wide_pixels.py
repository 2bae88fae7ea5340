"""Noise-free views of balls before wide pixels, integrated over finite holes; OSEM by footprints.

PYTHONPATH=plugins/mvrecon-spect/tests python experiments/28_montecarlo/wide_pixels.py RUN_FOLDER
"""

import sys
from pathlib import Path

import torch
from test_footprints import FWHM, fine_views_of_finite_hole
from torch import Tensor
from torch.nn.functional import conv2d
from wide import GRID, HOLE, phantom, rig, rows

from mvrecon.core.files.runs import write_rows
from mvrecon_spect.operators.projector import Spect

PARTS, FAR = 4, 1000.0


def blurred(fine: Tensor, sigma: float) -> Tensor:
    """A view after a Gaussian of sigma pixels."""
    if not sigma:
        return fine
    at = torch.arange(-round(5 * sigma), round(5 * sigma) + 1, dtype=torch.float64)
    kernel = torch.exp(-(at**2) / (2 * sigma**2))
    kernel = (kernel / kernel.sum())[None, None, None]
    return conv2d(conv2d(fine[None, None], kernel, padding="same"), kernel.mT, padding="same")[0, 0]


def main(folder: Path) -> None:
    """The views, and today's rows."""
    folder.mkdir(parents=True, exist_ok=True)
    balls, cameras = phantom(), rig()

    def integral(start: Tensor, along: Tensor) -> Tensor:
        return balls.integrals(start, start + FAR * along)

    fine = [fine_views_of_finite_hole(camera, integral, HOLE, PARTS) for camera in cameras]
    assert all(view[[0, -1]].max() == 0 and view[:, [0, -1]].max() == 0 for view in fine)
    views = {}
    for intrinsic in (0.0, 2.0):
        sigmas = [intrinsic / FWHM / camera.u.norm().item() * PARTS for camera in cameras]
        made = torch.stack([blurred(v, s) for v, s in zip(fine, sigmas, strict=True)])
        whole = made.unflatten(1, (-1, PARTS)).unflatten(3, (-1, PARTS)).sum(dim=(2, 4))
        views[intrinsic] = whole[None, None].float()
    torch.save(views, folder / "wide_views.pt")

    def build(intrinsic: float) -> Spect:
        return Spect(GRID, cameras, HOLE, blur=True, intrinsic_mm=intrinsic)

    write_rows(folder / "wide.csv", rows("", build, folder))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
