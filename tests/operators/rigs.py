"""Rigs and grids that a projector must be right for."""

from dataclasses import replace

import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Grid

GRID = Grid.centred(size=(7, 6, 5), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
DETECTOR = {"pixels": [5, 6], "pixel_mm": [2.1, 2.3], "offset_mm": [0.4, -0.3]}
CONE = circular(4, 40.0, 70.0, DETECTOR, start_degrees=13.0).moved(torch.eye(3), GRID.centre)
PINHOLES = dome(4, 30.0, 20.0, 120.0, DETECTOR, target=GRID.centre.tolist())
PARALLEL = parallel(4, DETECTOR, 60.0, start_degrees=11.0).moved(torch.eye(3), GRID.centre)
#: Sources in the box, none on a voxel's face.
INSIDE = replace(
    CONE, source=GRID.centre + torch.tensor([0.9, -0.7, 0.6]) + 0.02 * (CONE.source - GRID.centre)
)
#: Central rays along the grid's axes, through the centres of voxels.
AXIAL = circular(4, 40.0, 70.0, {"pixels": [5, 5], "pixel_mm": 2.0}).moved(
    torch.eye(3), GRID.centre + torch.tensor([0.0, 0.6, 0.0])
)

CENTRAL: dict[str, Cameras] = {"cone": CONE, "pinholes": PINHOLES, "inside": INSIDE, "axial": AXIAL}
#: The projector for each, and the rig.
RIGS: dict[str, tuple[str, Cameras]] = {kind: ("drr", rig) for kind, rig in CENTRAL.items()}
RIGS |= {
    "parallel": ("radon", PARALLEL),
    "line": ("radon", replace(PARALLEL, extent="line")),
}
