"""RTK, the Reconstruction Toolkit of ITK: its Joseph filters on the CPU
(https://www.openrtk.org).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.cameras.formats.rtk_xml import gantry_angles
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, load
from mvrecon_peers.frame import require_between

#: Empty voxels around the volume: RTK's volume ends at the centres of the outer voxels, and the
#: first step of a ray in it is inaccurate.
RIM = 2
#: As a fraction of the volume's size: RTK's matrices lose their precision if a detector is this
#: close to its source.
SHORT = 1e-6
#: Maximum ratio of voxel edges: RTK rotates rays in mm, which introduces rounding errors in very
#: fine voxels.
OBLONG = 1e3


def view_arguments(box: Grid, rig: Cameras) -> list[tuple[float, ...]]:
    """Arguments of RTK's `AddProjectionInRadians` for each view.

    Source-to-isocentre and source-to-detector distances (0: parallel rays); gantry angle, detector
    offsets, out-of-plane and in-plane angle, source offsets. RTK's own interface for vectors has
    only five digits if a detector faces the y axis.

    Raises:
        ValueError: detectors that are not rectangular, pixels that differ between views, or
            parallel beams that are not perpendicular to their detector.
    """
    u, v = (torch.nn.functional.normalize(step, dim=-1) for step in (rig.u, rig.v))
    if (skew := (u * v).sum(-1).abs().max().item()) > 1e-6:
        raise ValueError(
            f"RTK takes detectors with right angles, got rows and columns with the cosine "
            f"{skew:.3g}"
        )
    for what, step in (("columns", rig.u), ("rows", rig.v)):
        pitch = step.norm(dim=-1)
        if not torch.allclose(pitch, pitch[0], rtol=1e-6, atol=0):
            raise ValueError(
                f"RTK takes one pixel size for all views, got {what} of {pitch.unique().tolist()} "
                f"mm"
            )
    axes = torch.stack([u, v, torch.linalg.cross(u, v)], dim=1)
    centre = rig.detector_centre
    across, down, depth = (axes * centre[:, None]).sum(dim=-1).unbind(dim=-1)
    x, y, z = (axes * rig.source[:, None]).sum(dim=-1).unbind(dim=-1)
    below = z - depth
    if rig.parallel:
        require_square(box, rig, axes[:, 2])
        x = y = below = torch.zeros_like(depth)
        z = torch.full_like(depth, box.corners().norm(dim=-1).max().item() + 3 * sum(box.spacing))
    elif (short := below.abs().min().item()) < SHORT * (
        size := box.corners().norm(dim=-1).max().item()
    ):
        raise ValueError(
            f"RTK takes detectors no nearer to the source than {SHORT:g} of the volume's size, "
            f"got {short / size:.2g}"
        )
    gantry, out, inner = zip(*map(gantry_angles, axes.tolist()), strict=True)
    z, below, across, down, x, y = (column.tolist() for column in (z, below, across, down, x, y))
    return list(zip(z, below, gantry, across, down, out, inner, x, y, strict=True))


def require_square(box: Grid, rig: Cameras, normal: Float[Tensor, "m 3"]) -> None:
    """Raise ValueError unless parallel rays are perpendicular to their detector and the box is
    between their end points.
    """
    require_between(box, rig, "RTK's parallel geometry")
    look = torch.nn.functional.normalize(rig.origin - rig.source, dim=-1)
    if (slant := torch.linalg.cross(look, normal).norm(dim=-1).max().item()) > 1e-6:
        raise ValueError(
            f"RTK takes parallel beams square to their detector, got one slanted by {slant:.3g}"
        )


class Rtk(Paired):
    """RTK's Joseph forward and back-projection, a matched pair on the CPU in float32 or float64.

    Supports every rig with rectangular detectors and one pixel size: cone beams, pinholes and
    parallel beams.

    Args:
        grid: voxels of the volume.
        cameras: the rig.

    Raises:
        ValueError: a geometry that RTK does not support, or cameras that require a gradient.
        ImportError: RTK is not installed.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        if (ratio := max(self.box.spacing) / min(self.box.spacing)) > OBLONG:
            raise ValueError(
                f"RTK takes voxels at most {OBLONG:g} times as long as wide, got {ratio:.3g} times"
            )
        # ITK has tolerances in mm, so lengths are scaled by a power of two to voxels of about 1
        self.unit = 2.0 ** round(math.log2(min(self.box.spacing)))
        box = Grid.centred(size=grid.size, spacing=[mm / self.unit for mm in self.box.spacing])
        rig = replace(self.rig, **{name: getattr(self.rig, name) / self.unit for name in VECTORS})
        views = view_arguments(box, rig)
        self.itk, self.rtk = load("itk", "itk-rtk"), load("itk", "itk-rtk", "RTK")
        self.geometry = self.rtk.ThreeDCircularProjectionGeometry.New()
        for view in views:
            if self.geometry.AddProjectionInRadians(*view) is False:
                raise ValueError(f"RTK does not take the view {view}")
        pitch = [rig.u[0].norm().item(), rig.v[0].norm().item(), 1.0]
        rows, columns = rig.shape
        self.detector = pitch, [-pitch[0] * (columns - 1) / 2, -pitch[1] * (rows - 1) / 2, 0.0]
        rim = Grid.centred(size=[n + 2 * RIM for n in grid.size], spacing=box.spacing)
        self.voxels = list(rim.spacing), rim.affine[:3, 3].tolist()

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """JosephForwardProjectionImageFilter."""
        empty = self._image(volume.new_zeros(len(self.rig), *self.rig.shape), self.detector)
        image = self._image(torch.nn.functional.pad(volume, (RIM,) * 6), self.voxels)
        return self._run(self.rtk.JosephForwardProjectionImageFilter, empty, image)

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """JosephBackProjectionImageFilter."""
        empty = self._image(views.new_zeros([n + 2 * RIM for n in self.grid.shape]), self.voxels)
        volume = self._run(
            self.rtk.JosephBackProjectionImageFilter, empty, self._image(views, self.detector)
        )
        return volume[RIM:-RIM, RIM:-RIM, RIM:-RIM]

    def reconstruct(
        self, name: str, views: Float[Tensor, "m v u"], configure: Callable[[Any], None]
    ) -> Float[Tensor, "d h w"]:
        """Reconstruct by the named filter after `configure(filter)`, in 1/mm."""
        box = Grid.centred(size=self.grid.size, spacing=self.voxels[0])
        empty = self._image(
            views.new_zeros(self.grid.shape), (self.voxels[0], box.affine[:3, 3].tolist())
        )
        kind = getattr(self.rtk, name)
        method = kind[next(key for key in kind.keys() if key[0] is type(empty))].New()
        method.SetGeometry(self.geometry)
        stack = self._image(views, self.detector)
        if hasattr(method, "SetInputProjectionStack"):
            method.SetInputVolume(empty)
            method.SetInputProjectionStack(stack)
        else:
            method.SetInput(0, empty)
            method.SetInput(1, stack)
        configure(method)
        method.Update()
        return torch.from_numpy(self.itk.array_from_image(method.GetOutput())) / self.unit

    def _image(self, values: Tensor, frame: tuple[list[float], list[float]]):
        image = self.itk.image_view_from_array(values.numpy())
        if values[0].numel() == 1:  # ITK would read this memory in Fortran order
            image = type(image).New()
            image.SetRegions(values.shape[::-1])
            image.Allocate()
            self.itk.array_view_from_image(image)[:] = values.numpy()
        image.SetSpacing(frame[0])
        image.SetOrigin(frame[1])
        return image

    def _run(self, kind, target, source) -> Tensor:
        operator = kind[type(target), type(source)].New()
        operator.SetNumberOfWorkUnits(torch.get_num_threads())
        operator.SetGeometry(self.geometry)
        operator.SetInput(0, target)
        operator.SetInput(1, source)
        operator.Update()
        return torch.from_numpy(self.itk.array_from_image(operator.GetOutput())) * self.unit
