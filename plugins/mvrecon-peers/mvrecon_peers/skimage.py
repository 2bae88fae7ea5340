"""scikit-image's Radon transform, which rotates the image and sums its rows
(https://scikit-image.org).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, load, quiet
from mvrecon_peers.frame import plane_of_rows, require_between


def turns(box: Grid, rig: Cameras) -> tuple[list[float], list[int]]:
    """Angle of each view in degrees, and the column onto which the axis of rotation projects, the
    centre of voxel size // 2.

    Raises:
        ValueError: cameras that are not parallel or not perpendicular to their detector, columns of
            another width than the voxels, or an axis between two columns.
    """
    width, height = box.spacing[:2]
    pitch = rig.u.norm(dim=-1)
    if not rig.parallel:
        raise ValueError("scikit-image's radon takes parallel beams, got central cameras")
    if abs(width / height - 1) > 1e-6 or (pitch / width - 1).abs().max() > 1e-6:
        raise ValueError(
            f"scikit-image's radon takes square voxels as wide as the detector's columns, got "
            f"{width:.6g} by "
            f"{height:.6g} mm and columns of {pitch.unique().tolist()} mm"
        )
    look = torch.nn.functional.normalize(rig.origin - rig.source, dim=-1)
    if (slant := (look * rig.u / pitch[:, None]).sum(-1).abs().max().item()) > 1e-6:
        raise ValueError(
            f"scikit-image's radon takes beams square to their detector, got one slanted by "
            f"{slant:.3g}"
        )
    depth, rows, columns = box.shape
    axis = box.to_world(torch.tensor([columns // 2, rows // 2, depth / 2], dtype=torch.float64))
    axis_columns = rig.project(axis)[:, 0]
    if (off := (axis_columns - axis_columns.round()).abs().max().item()) > 1e-3:
        raise ValueError(
            f"scikit-image's radon turns the image about the centre of voxel size // 2, which "
            f"must fall on the centre "
            f"of a column, got it {off:.3g} columns off; take odd sizes of grid and detector"
        )
    angles = torch.rad2deg(torch.atan2(-rig.u[:, 1], rig.u[:, 0]))
    return angles.tolist(), [int(column) for column in axis_columns.round()]


class Skimage(Paired):
    """scikit-image's radon, slice by slice on one thread; its back projection is iradon without a
    filter.

    The pair is not matched: radon interpolates in the rotated image, iradon in the views. Detector
    rows must lie in the central planes of slices (or outside the grid).

    Args:
        grid: voxels of the volume.
        cameras: the rig.

    Raises:
        ValueError: a geometry that radon does not support, or cameras that require a gradient.
        ImportError: scikit-image is not installed.
    """

    matched = False

    def __init__(self, grid: Grid, cameras: Cameras):
        super().__init__(grid, cameras)
        self.angles, self.columns = turns(self.box, self.rig)
        self.pairs = plane_of_rows(self.box, self.rig, "scikit-image's radon")
        require_between(self.box, self.rig, "scikit-image's radon")
        self.transform = load("skimage.transform", "scikit-image")

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """Radon transform of every slice that projects onto a row."""
        views = volume.new_zeros(len(self.rig), *self.rig.shape)
        for row, index in self.pairs:
            with quiet():
                lines = self.transform.radon(
                    volume[index].numpy(), self.angles, circle=False, preserve_range=True
                )
            views[:, row] = self._columns(torch.from_numpy(lines).T, views.shape[2], 1)
        return views * self.box.spacing[0]

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """Unfiltered iradon of every row, without its weight pi / 2 m."""
        volume = views.new_zeros(self.grid.shape)
        side = max(volume.shape[1:]) * 2
        for row, index in self.pairs:
            lines = self._columns(views[:, row], side, -1).T.numpy()
            options = {"filter_name": None, "circle": False, "preserve_range": True}
            options |= {"output_size": side}
            with quiet():
                square = torch.from_numpy(self.transform.iradon(lines, self.angles, **options))
            top, left = (side // 2 - n // 2 for n in volume.shape[1:])
            volume[index] += square[top : top + volume.shape[1], left : left + volume.shape[2]]
        return volume * (2 * len(self.rig) / torch.pi * self.box.spacing[0])

    def _columns(self, lines: Float[Tensor, "m a"], size: int, sign: int) -> Float[Tensor, "m b"]:
        """Views with the axis in their column size // 2, shifted to our columns (sign 1) or back
        (sign -1).
        """
        moved = lines.new_zeros(len(lines), size)
        for line, out, axis in zip(lines, moved, self.columns, strict=True):
            shift = axis - lines.shape[1] // 2 if sign > 0 else size // 2 - axis
            first, last = max(0, shift), min(size, shift + len(line))
            if first < last:
                out[first:last] = line[first - shift : last - shift]
        return moved
