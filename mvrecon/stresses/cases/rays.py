"""Rays in special places: along axes, on faces, through corners, inside, beside and beyond the volume."""

import torch

from mvrecon.geometry.grid import Grid
from mvrecon.stresses.case import Case
from mvrecon.stresses.subject import ProjectorSubject

#: Exact in float64 but for the rotation of a ray into voxels; float32 rounds each of about ten sums.
EXACT = {torch.float64: 1e-13, torch.float32: 1e-6}


def axis_aligned(subject: ProjectorSubject) -> float:
    """Rays through rows of voxel centres, along all three axes, both ways: plain sums times the spacing."""
    subject.need_exact()
    worst = 0.0
    for n in (4, 5):
        grid = Grid.centred((n, n + 1, n + 2), (0.9, 1.2, 1.0), (3.0, -2.0, 4.0))
        volume = subject.random(*grid.shape).cpu()
        for axis in range(3):  # x, y, z
            other = [i for i in range(3) if i != axis]
            counts = [grid.shape[2 - i] for i in other]
            index = torch.cartesian_prod(*[torch.arange(count, dtype=torch.float64) for count in counts])
            start, end = (torch.zeros(len(index), 3, dtype=torch.float64) for _ in range(2))
            start[:, other], end[:, other] = index, index
            start[:, axis], end[:, axis] = -20.0, 30.0
            sums = volume.double().sum(dim=2 - axis).mT.flatten() * grid.spacing[axis]
            for a, b in ((start, end), (end, start)):
                seen = subject.values(grid, grid.to_world(a), grid.to_world(b), volume)
                worst = max(worst, float((seen - sums).abs().max() / sums.max()))
    return worst


CASES = (Case(1, "rays along the axes", "a sum of voxels times the spacing", "projector", axis_aligned, EXACT),)
