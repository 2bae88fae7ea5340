"""OSEM of a ball of 25 mm and small ones before pixels of 1.6 mm: error of the volume."""

from collections.abc import Callable
from pathlib import Path

import torch

import mvrecon as mv
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.operators.operator import LinearOperator

GRID, HOLE, PIXELS = mv.Grid.centred(40, spacing=2.5), 2.3, 32
CENTRES = [[0, 0, 0], [34, 0, 0], [-24, 24, 0], [0, -34, 0], [0, 0, 32], [0, 0, -32]]
RADII = [25.0, 6.0, 5.0, 4.0, 5.0, 4.0]


def rig() -> mv.Cameras:
    """16 cameras."""
    return mv.dcspect80(pixels=PIXELS, columns=[0, 5, 10, 15])


def phantom() -> Phantom:
    """Balls of activity one."""
    centres, sizes = torch.tensor(CENTRES) * 1.0, torch.tensor(RADII)[:, None].expand(-1, 3)
    return Phantom((Solids.upright("ellipsoid", centres, sizes, torch.ones(len(sizes))),))


def rows(version: str, build: Callable[[float], LinearOperator], folder: Path) -> list[dict]:
    """Error after 20 iterations of 4 subsets, greatest voxel, and error of the views of the truth.

    Args:
        version: of mvrecon.
        build: the operator by the intrinsic resolution in mm.
        folder: with the views.
    """
    truth, found = voxelise(phantom(), GRID)[None, None], []
    for intrinsic, y in torch.load(folder / "wide_views.pt").items():
        A = build(intrinsic)
        x = mv.osem(A, y, 20, 4)
        found.append(
            {
                "version": version,
                "intrinsic_mm": intrinsic,
                "views_error": f"{((A(truth) - y).norm() / y.norm()).item():.4f}",
                "nrmse": f"{((x - truth).norm() / truth.norm()).item():.3f}",
                "greatest": f"{x.max().item():.2f}",
            }
        )
    return found
