"""Mirror symmetry of a rig: half of its rays determine the matrix elements of the other half.

A mirrored camera is left-handed. With rows or columns reversed it is right-handed again; if that
camera is in the rig, each of the two sees the mirrored object as the other sees the object.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import unit

#: Axes of views that a mirror reverses.
ROW_AXIS, COLUMN_AXIS = -2, -1


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane through a grid's centre that mirrors the grid and the rig into themselves: A(F x) =
    G(A x).

    Args:
        axis: axis of the volume, -3, -2 or -1 for (z, y, x), which F reverses.
        partner: index of each camera's mirror image; its own if it lies on the plane.
        rows: whether a camera's rows are reversed in its partner's; otherwise its columns are.
    """

    axis: int
    partner: Int[Tensor, " m"]
    rows: Bool[Tensor, " m"]

    def volume(self, volume: Float[Tensor, "*b d h w"]) -> Float[Tensor, "*b d h w"]:
        """Mirror a volume: F x."""
        return volume.flip(self.axis)

    def views(self, views: Float[Tensor, "*b m v u"]) -> Float[Tensor, "*b m v u"]:
        """The views G y of the mirrored object, from the views y of the object."""
        other = views[..., self.partner.to(views.device), :, :]
        return torch.where(
            self.rows[:, None, None].to(views.device), other.flip(ROW_AXIS), other.flip(COLUMN_AXIS)
        )

    @property
    def share(self) -> Float[Tensor, " m"]:
        """Weight of each camera in half of the rig: 1 and 0 for partners, 1/2 for self-symmetric
        ones. The half and its image make up the rig.
        """
        return 0.5 * (1 + (self.partner - torch.arange(len(self.partner))).sign())


@torch.no_grad()
def mirror_pairs(cameras: Cameras, grid: Grid, tolerance: float = 1e-9) -> Mirror | None:
    """Find the mirror symmetry about a central plane of a grid that pairs the most cameras; None if
    there is none.

    Args:
        cameras: the rig.
        grid: its central planes; axes that are not perpendicular to the others have none.
        tolerance: greatest deviation of a source or detector corner from its mirror image, relative
            to the rig's size (greatest distance from the grid's centre).
    """
    places = _places(cameras, grid)
    axes = unit(grid.affine[:3, :3], dim=0).T
    oblique = (axes @ axes.T).fill_diagonal_(0).abs().amax(dim=1) > tolerance
    mirrors = [
        Mirror(-1 - column, *matched)
        for column in (2, 1, 0)
        if not oblique[column] and (matched := _partners(places, axes[column], tolerance))
    ]
    return min(mirrors, key=lambda mirror: mirror.share.count_nonzero().item(), default=None)


def _places(cameras: Cameras, grid: Grid) -> Float[Tensor, "m 2 2 2 3"]:
    """Both ends of the rays through the outer corners (v, u) of each detector, in mm from the
    grid's centre.
    """
    v, u = (cameras.source.new_tensor([-0.5, n - 0.5])[:, None] for n in cameras.shape)
    across = (v * cameras.v[:, None])[:, :, None] + (u * cameras.u[:, None])[:, None]
    start = cameras.source[:, None, None] + (
        across if cameras.parallel else torch.zeros_like(across)
    )
    end = cameras.origin[:, None, None] + across
    return torch.stack([start, end], dim=3) - grid.centre.to(across)


def _partners(
    places: Float[Tensor, "m 2 2 2 3"], normal: Float[Tensor, "3"], tolerance: float
) -> tuple[Int[Tensor, " m"], Bool[Tensor, " m"]] | None:
    """Each camera's mirror image across a plane through zero, and whether rows are reversed; None
    if one is missing.
    """
    normal = normal.to(places)
    mirrored = places - 2 * (places @ normal)[..., None] * normal
    near = tolerance * places.norm(dim=-1).max()
    gaps = [
        torch.cdist(mirrored.flip(axis).flatten(1), places.flatten(1), p=torch.inf)
        for axis in (1, 2)
    ]
    by_rows, by_columns = (gap < near for gap in gaps)
    partner = [-1] * len(places)
    for m, images in enumerate((by_rows | by_columns).tolist()):
        if partner[m] < 0:
            free = next((n for n, same in enumerate(images) if same and partner[n] < 0), None)
            if free is None:
                return None
            partner[m], partner[free] = free, m
    partners = torch.tensor(partner)
    return partners, by_rows.cpu()[torch.arange(len(partners)), partners]


def same_weights(one: Shaped[Tensor, "*n"], other: Shaped[Tensor, "*#n"]) -> bool:
    """Whether weights are equal up to rounding; masks exactly."""
    if one.dtype == torch.bool:
        return torch.equal(one, other)
    return torch.allclose(one, other.expand_as(one), rtol=1e-9, atol=0)
