"""Values of a cylinder by filtered back-projection of scans whose panels differ between views, or
that lack lines.

python experiments/30_scan_effects/panels.py experiments/30_scan_effects
"""

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.core.files.runs import write_rows
from mvrecon.data.scenes.solids import Phantom, Solids
from mvrecon.geometry.grid import voxel_centres
from mvrecon.geometry.rigid import unit
from mvrecon.operators.stacked import joined_cameras

VALUE, RADIUS, CENTRE = 0.02, 40.0, (3.0, -5.0, 0.0)
GRID = mv.Grid.centred(size=(64, 64, 1), spacing=1.8)
TURN = torch.arange(360.0)
RNG = torch.Generator().manual_seed(1)


def panel(columns: int, pixel_mm: float, shift_mm: float = 0.0) -> dict:
    return {"pixels": [1, columns], "pixel_mm": pixel_mm, "offset_mm": [0.0, shift_mm]}


def fan(detector: dict, angles: torch.Tensor) -> mv.Cameras:
    return mv.circular(len(angles), 400.0, 600.0, detector, angles=angles.tolist())


def beam(detector: dict, angles: torch.Tensor) -> mv.Cameras:
    return mv.parallel(len(angles), detector, angles=angles.tolist(), depth_mm=400.0)


def shifted(rig: mv.Cameras, mm: torch.Tensor) -> mv.Cameras:
    """Each panel moved along its rows by its own distance."""
    return replace(rig, origin=rig.origin + mm.double()[:, None] * unit(rig.u))


def blocks(count: int) -> mv.Cameras:
    """Half fans of either side by turns, in blocks of so many views."""
    return shifted(fan(panel(66, 2.0), TURN), 35.0 - 70.0 * (TURN // count % 2))


def jittered(mm: float) -> mv.Cameras:
    """Half panels of parallel beams with an overlap of 30 mm, each at a place of its own."""
    return shifted(beam(panel(80, 1.0, 25.0), TURN), mm * (2 * torch.rand(360, generator=RNG) - 1))


FULL, HALF = panel(100, 2.0), panel(100, 1.32, 35.0)
SCANS = {
    "full turn": fan(FULL, TURN),
    **{f"half fans of both sides in blocks of {n}": blocks(n) for n in (1, 2, 3, 4, 5)},
    "panels at +35 and -30 mm by turns": shifted(
        fan(panel(66, 2.0), TURN), torch.tensor([35.0, -30.0]).repeat(180)
    ),
    **{
        f"half fan, and full fan over {n} degrees": joined_cameras(
            [fan(HALF, TURN), fan(FULL, TURN[:n])]
        )
        for n in (120, 210, 300)
    },
    "half fan, and 210 degrees of the other half": joined_cameras(
        [fan(HALF, TURN), fan(panel(100, 1.32, -35.0), TURN[50:260] + 0.5)]
    ),
    "short scans of two widths": joined_cameras(
        [fan(FULL, TURN[:210]), fan(panel(100, 2.4), TURN[150:360])]
    ),
    **{
        f"parallel, half and full panel over 180 degrees each, {words}": joined_cameras(
            [beam(panel(80, 1.0, 25.0), TURN[:180]), beam(panel(128, 1.0), TURN[:180] + apart)]
        )
        for words, apart in (("at the same angles", 0.0), ("half a degree apart", 0.5))
    },
    **{
        f"parallel, half panels that jitter by {mm:g} mm, draw {draw}": jittered(mm)
        for mm in (5.0, 10.0)
        for draw in range(8)
    },
    **{f"arc of {n} degrees in place of 199": fan(FULL, TURN[:n]) for n in (199, 190, 180)},
}


def main(folder: Path) -> None:
    """Greatest and mean error in per cent within 30 mm of the cylinder's axis."""
    size, centre = torch.tensor([[RADIUS, RADIUS, 150.0]]), torch.tensor([CENTRE])
    cylinder = Phantom((Solids.upright("cylinder", centre, size, torch.tensor([VALUE])),))
    inside = (voxel_centres(GRID) - centre[0])[..., :2].norm(dim=-1) < 30.0
    rows = []
    for name, rig in SCANS.items():
        views = cylinder.views(rig)[None, None].float()
        A = mv.Radon(GRID, rig) if rig.parallel else mv.Drr(GRID, rig)
        row: dict = {"scan": name, "greatest": "", "mean": "", "said": "error"}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                off = mv.fbp(A, views)[0, 0][inside] / VALUE - 1
            except ValueError as error:
                print(name, error)
            else:
                row["greatest"] = round(100 * off.abs().max().item(), 2)
                row["mean"] = round(100 * off.mean().item(), 2)
                row["said"] = "warning" if caught else ""
        rows.append(row)
    write_rows(folder / "panels.csv", rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
