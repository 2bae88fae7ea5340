"""Attenuated rays beside RTK's attenuated Joseph, whose counts run towards the detector, too."""

import numpy as np
import pytest
import torch

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.attenuated import AttenuatedTransform

itk = pytest.importorskip("itk", reason="itk-rtk is not installed")
rtk = getattr(itk, "RTK", None)
pytestmark = pytest.mark.skipif(rtk is None, reason="itk-rtk is not installed")

SIZE, SPACING, SID, SDD = 40, 4.0, 294.0, 383.0
ROWS, COLUMNS, PITCH = 16, 20, 8.0


def image(values, origin, spacing):
    made = itk.image_from_array(np.ascontiguousarray(values, dtype=np.float32))
    made.SetOrigin(origin)
    made.SetSpacing(spacing)
    return made


def blob(grid, centre, width):
    distance = (voxel_centres(grid) - torch.tensor(centre)).norm(dim=-1)
    return torch.exp(-((distance / width) ** 2) / 2).float()


def test_attenuated_integrals_agree_with_rtk():
    grid = Grid.centred(SIZE, spacing=SPACING)
    mu, emission = 0.01536 * blob(grid, (10, 0, -5), 35), blob(grid, (-12, 8, 0), 25)
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    geometry.AddProjection(SID, SDD, 0.0)  # from (0, 0, SID) along -z
    kind = itk.Image[itk.F, 3]
    run = rtk.JosephForwardAttenuatedProjectionImageFilter[kind, kind].New()
    corner = [-(COLUMNS - 1) / 2 * PITCH, -(ROWS - 1) / 2 * PITCH, 0]
    run.SetInput(0, image(np.zeros((1, ROWS, COLUMNS)), corner, [PITCH, PITCH, 1]))
    for place, volume in enumerate((emission, mu), start=1):
        first = [-(SIZE - 1) / 2 * SPACING] * 3
        run.SetInput(place, image(volume.numpy(), first, [SPACING] * 3))
    run.SetGeometry(geometry)
    run.Update()
    theirs = torch.from_numpy(itk.array_from_image(run.GetOutput()).copy())[0]
    # RTK's columns run to the left as the source sees them: ours begin at the other end
    cameras = Cameras(
        source=torch.tensor([[0.0, 0.0, SID]]),
        origin=torch.tensor([[-corner[0], corner[1], SID - SDD]]),
        u=torch.tensor([[-PITCH, 0.0, 0.0]]),
        v=torch.tensor([[0.0, PITCH, 0.0]]),
        shape=(ROWS, COLUMNS),
    )
    ours = AttenuatedTransform(grid, cameras, mu)(emission[None, None])[0, 0, 0].flip(-1)
    assert (ours - theirs).norm() < 2e-3 * theirs.norm()
