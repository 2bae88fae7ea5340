"""RTK, the Reconstruction Toolkit of ITK: its Joseph filters on the CPU (https://www.openrtk.org)."""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, load
from mvrecon_peers.frame import require_between


def view_arguments(box: Grid, rig: Cameras) -> list[tuple]:
    """What RTK's `AddProjection` takes for each view.

    A cone beam: source, detector's centre, and the directions of rows and columns. A parallel beam: half the length of
    the rays, 0 for no source, and the detector's angles in degrees and offsets in mm; see `parallel_arguments`.

    Raises:
        ValueError: detectors that are not rectangular, pixels that differ between views, or parallel beams that are
            not square to their detector.
    """
    rows, columns = rig.shape
    u, v = (torch.nn.functional.normalize(step, dim=-1) for step in (rig.u, rig.v))
    if (skew := (u * v).sum(-1).abs().max().item()) > 1e-6:
        raise ValueError(f"RTK takes detectors with right angles, got rows and columns with the cosine {skew:.3g}")
    for what, step in (("columns", rig.u), ("rows", rig.v)):
        pitch = step.norm(dim=-1)
        if not torch.allclose(pitch, pitch[0], rtol=1e-6, atol=0):
            raise ValueError(f"RTK takes one pixel size for all views, got {what} of {pitch.unique().tolist()} mm")
    centre = rig.origin + rig.u * (columns - 1) / 2 + rig.v * (rows - 1) / 2
    if rig.parallel:
        return parallel_arguments(box, rig, centre, torch.stack([u, v, torch.linalg.cross(u, v)], dim=1))
    return list(zip(*(vectors.tolist() for vectors in (rig.source, centre, u, v)), strict=True))


def parallel_arguments(
    box: Grid, rig: Cameras, centre: Float[Tensor, "m 3"], axes: Float[Tensor, "m 3 3"]
) -> list[tuple]:
    """sid, 0, gantry angle, offsets, out-of-plane and in-plane angle, of axes = Rz(-in) Rx(-out) Ry(-gantry)."""
    require_between(box, rig, "RTK's parallel geometry")
    look = torch.nn.functional.normalize(rig.origin - rig.source, dim=-1)
    if (slant := torch.linalg.cross(look, axes[:, 2]).norm(dim=-1).max().item()) > 1e-6:
        raise ValueError(f"RTK takes parallel beams square to their detector, got one slanted by {slant:.3g}")
    reach = box.corners().norm(dim=-1).max().item() + sum(box.spacing)
    out = torch.asin(axes[:, 2, 1].clamp(-1, 1))
    locked = out.cos() < 1e-9  # a beam along y: only the sum of the other two angles counts
    gantry = torch.where(locked, torch.atan2(axes[:, 0, 2], axes[:, 0, 0]), torch.atan2(-axes[:, 2, 0], axes[:, 2, 2]))
    inner = torch.where(locked, 0.0, torch.atan2(-axes[:, 0, 1], axes[:, 1, 1]))
    gantry, out, inner = (-torch.rad2deg(angle) for angle in (gantry, out, inner))
    across, down = (axes[:, :2] @ centre[..., None])[..., 0].unbind(dim=-1)
    rest = (angles.tolist() for angles in (gantry, across, down, out, inner))
    return [(reach, 0.0, *view) for view in zip(*rest, strict=True)]


class Rtk(Paired):
    """RTK's Joseph forward and back projection, a matched pair on the CPU, in float32 or float64.

    Takes every rig with rectangular detectors and one pixel size: cone beams, pinholes, and parallel beams.

    Args:
        grid: where the voxels lie.
        cameras: the rig.

    Raises:
        ValueError: a geometry that RTK does not take, or cameras that require a gradient.
        ImportError: RTK is not installed.
    """

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        views = view_arguments(self.box, self.rig)
        self.itk, self.rtk = load("itk", "itk-rtk"), load("itk", "itk-rtk", "RTK")
        self.geometry = self.rtk.ThreeDCircularProjectionGeometry.New()
        for view in views:
            if self.geometry.AddProjection(*view) is False:
                raise ValueError(f"RTK does not take the view {view}")
        pitch = [self.rig.u[0].norm().item(), self.rig.v[0].norm().item(), 1.0]
        rows, columns = self.rig.shape
        self.detector = pitch, [-pitch[0] * (columns - 1) / 2, -pitch[1] * (rows - 1) / 2, 0.0]
        self.voxels = list(self.box.spacing), self.box.affine[:3, 3].tolist()

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """JosephForwardProjectionImageFilter."""
        empty = self._image(volume.new_zeros(len(self.rig), *self.rig.shape), self.detector)
        return self._run(self.rtk.JosephForwardProjectionImageFilter, empty, self._image(volume, self.voxels))

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """JosephBackProjectionImageFilter."""
        empty = self._image(views.new_zeros(self.grid.shape), self.voxels)
        return self._run(self.rtk.JosephBackProjectionImageFilter, empty, self._image(views, self.detector))

    def _image(self, values: Tensor, frame: tuple[list[float], list[float]]):
        image = self.itk.image_view_from_array(values.numpy())
        image.SetSpacing(frame[0])
        image.SetOrigin(frame[1])
        return image

    def _run(self, kind, target, given) -> Tensor:
        operator = kind[type(target), type(given)].New()
        operator.SetNumberOfWorkUnits(torch.get_num_threads())
        operator.SetGeometry(self.geometry)
        operator.SetInput(0, target)
        operator.SetInput(1, given)
        operator.Update()
        return torch.from_numpy(self.itk.array_from_image(operator.GetOutput()))
