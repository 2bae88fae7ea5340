import pytest
import torch

from mvrecon.geometry.grid import Grid


class ParallelRig:
    """Rays along x and along y through a cube of 120 mm, three to a voxel, with no camera behind
    them.
    """

    ray_extent = (0.0, 1.0)

    def rays(self):
        across = (torch.arange(72, dtype=torch.float64) - 35.5) * 5 / 3
        v, u = torch.meshgrid(across, across, indexing="ij")
        far = torch.full_like(u, 200.0)
        start = torch.stack([torch.stack([-far, u, v], -1), torch.stack([u, -far, v], -1)])
        end = torch.stack([torch.stack([far, u, v], -1), torch.stack([u, far, v], -1)])
        return start, end


@pytest.fixture
def rig():
    return ParallelRig()


@pytest.fixture
def grid():
    return Grid.centred((24, 24, 24), 5.0)
