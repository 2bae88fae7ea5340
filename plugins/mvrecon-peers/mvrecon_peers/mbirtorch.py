"""mbirtorch: separable footprints, fan by fan, in torch, with Triton kernels on CUDA (C. Bouman and
G. Buzzard).
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import check_choice
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, load, quiet
from mvrecon_peers.frame import plane_of_rows, require_between


class MbirtorchScan(NamedTuple):
    """A scan about the z axis in mbirtorch's convention: the object rotates, rows run along +z,
    channels in the reverse direction of ours.

    `turned`: rows and columns are reversed relative to the rig. Lengths are in mm, angles in
    radians; `offset` is the offset of channels and rows, `rise` the source's height in each view.
    """

    angles: Float[Tensor, " m"]
    rise: Float[Tensor, " m"]
    sid: float
    sdd: float
    pitch: tuple[float, float]
    offset: tuple[float, float]
    turned: bool


def scan_of(rig: Cameras) -> MbirtorchScan:
    """The scan about the z axis that describes a rig, derived from the first view and checked
    against all others.

    Raises:
        ValueError: the rig is not such a scan.
    """
    sign = 1.0 if rig.v[0, 2] > 0 else -1.0
    pitch = rig.u[0].norm().item(), rig.v[0].norm().item()
    normal = torch.nn.functional.normalize(torch.linalg.cross(rig.u[0], rig.v[0]), dim=-1)
    # as projected onto channel zero
    middle = torch.zeros_like(normal) if rig.parallel else rig.source[0] + normal
    place, zero = rig[0].project(middle)[0, :2].tolist(), [(n - 1) / 2 for n in rig.shape[::-1]]
    scan = MbirtorchScan(
        angles=torch.atan2(-sign * rig.u[:, 1], sign * rig.u[:, 0]),
        rise=torch.zeros_like(rig.source[:, 2]) if rig.parallel else rig.source[:, 2],
        sid=rig.source[0, :2].norm().item(),
        sdd=rig.distance[0].item(),
        pitch=pitch,
        offset=(sign * pitch[0] * (place[0] - zero[0]), sign * pitch[1] * (place[1] - zero[1])),
        turned=sign < 0,
    )
    off = departure(rig, rig_of(scan, rig))
    if off > 1e-6 * scan.sdd:
        raise ValueError(
            "mbirtorch takes a circle or a helix about the z axis through the volume's centre, "
            "with equal distances, "
            f"pixels and offsets, its detectors upright and square to it; got a rig {off:.3g} mm "
            f"off"
        )
    return scan


def departure(rig: Cameras, other: Cameras) -> float:
    """Difference of two rigs in mm; ignores the end points along parallel rays."""
    pitch, middle = torch.stack([rig.u[0].norm(), rig.v[0].norm()]), torch.zeros(3).double()

    def compared(cameras: Cameras) -> list[Tensor]:
        if not rig.parallel:
            return [getattr(cameras, name) for name in VECTORS]
        look = torch.nn.functional.normalize(cameras.origin - cameras.source, dim=-1)
        place = cameras.project(middle)[:, :2] * pitch
        return [cameras.u, cameras.v, look * rig.distance[0], place]

    pairs = zip(compared(rig), compared(other), strict=True)
    return max((a - b).abs().max().item() for a, b in pairs)


def rig_of(scan: MbirtorchScan, like: Cameras) -> Cameras:
    """The rig that a scan describes, with the detector of another rig."""
    sign = -1.0 if scan.turned else 1.0
    sine, cosine, none = scan.angles.sin(), scan.angles.cos(), torch.zeros_like(scan.angles)
    outwards = torch.stack([sine, cosine, none], dim=-1)
    across = torch.stack([cosine, -sine, none], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(across)
    u, v = sign * scan.pitch[0] * across, sign * scan.pitch[1] * up
    (rows, columns), axis = like.shape, scan.rise[:, None] * up
    u0, v0 = (
        sign * o / p + (n - 1) / 2
        for o, p, n in zip(scan.offset, scan.pitch, (columns, rows), strict=True)
    )
    corner = axis - u0 * u - v0 * v
    source = scan.sid * outwards + (corner if like.parallel else axis)
    origin = (scan.sid - scan.sdd) * outwards + corner
    return Cameras(source, origin, u, v, like.shape, like.parallel)


class Mbirtorch(Paired):
    """mbirtorch's forward and back projection, a matched pair in float32, on the CPU.

    Supports cone beams on a circle or helix about the grid's central z axis, and parallel beams
    about it whose detector rows lie in the central planes of slices (or outside the grid).

    Args:
        grid: voxels of the volume.
        cameras: the rig.
        compile_mode: mbirtorch's option: "auto" compiles at the first call, and again for another
            number of threads, which takes minutes (if a compiler is installed); or "off".

    Raises:
        ValueError: an unknown mode, a geometry that mbirtorch does not support, or cameras that
            require a gradient.
        ImportError: mbirtorch is not installed.
    """

    precisions = (torch.float32,)
    #: mbirtorch assigns zero weights to voxels near a ray.
    local = False

    def __init__(self, grid: Grid, cameras: Cameras, compile_mode: str = "off"):
        super().__init__(grid, cameras)
        self.scan = scan_of(self.rig)
        self.pairs = None
        if self.rig.parallel:
            self.pairs = plane_of_rows(self.box, self.rig, "mbirtorch's parallel beam")
        require_between(self.box, self.rig, "mbirtorch")
        check_choice("compile_mode", compile_mode, ("auto", "off"))
        self.model = self._model(compile_mode)

    def _model(self, mode: str) -> Any:
        library, scan = load("mbirtorch", "mbirtorch"), self.scan
        (depth, rows, columns), (x, y, z) = self.grid.shape, self.box.spacing
        angles, shape = scan.angles.numpy(), (len(self.rig), *self.rig.shape)
        options = {
            "recon_shape": (rows, columns, depth),
            "delta_voxel": x,
            "voxel_row_aspect": y / x,
            "delta_det_channel": scan.pitch[0],
            "det_channel_offset": scan.offset[0],
            "use_ror_mask": False,
        }
        with quiet():
            if self.rig.parallel:
                sizes = shape[0], depth, shape[2]
                model = library.ParallelBeamModel(sizes, angles, compile_mode=mode)
            else:
                rise = {"helical_z_shifts": scan.rise.numpy(), "compile_mode": mode}
                model = library.ConeBeamModel(shape, angles, scan.sdd, scan.sid, **rise)
                options |= {"delta_det_row": scan.pitch[1], "det_row_offset": scan.offset[1]}
                options |= {"recon_slice_offset": 0.0, "voxel_slice_aspect": z / x}
            model.set_params(no_warning=True, **options)
            model.configure_devices(devices=["cpu"])
        return model

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """mbirtorch's sparse_forward_project of all voxels, in the layout [(y x) z]."""
        operand = volume.permute(1, 2, 0).flatten(0, 1).contiguous()
        with quiet():
            made = self.model.sparse_forward_project(operand, self.model.full_indices_device())
        made = self._turned(made)
        if self.pairs is None:
            return made
        views = made.new_zeros(len(self.rig), *self.rig.shape)
        for row, index in self.pairs:
            views[:, row] = made[:, index]
        return views

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """mbirtorch's sparse_back_project."""
        operand = views
        if self.pairs is not None:
            operand = operand.new_zeros(len(self.rig), self.grid.shape[0], self.rig.shape[1])
            for row, index in self.pairs:
                operand[:, index] += views[:, row]
        operand = self._turned(operand).contiguous()
        with quiet():
            made = self.model.sparse_back_project(operand, self.model.full_indices_device())
        return made.unflatten(0, self.grid.shape[1:]).permute(2, 0, 1)

    def _turned(self, views: Float[Tensor, "m a u"]) -> Float[Tensor, "m a u"]:
        """Convert mbirtorch's order of rows and channels to ours, or back; rows of a parallel beam
        are slices in both.
        """
        if not self.scan.turned:
            return views
        return views.flip(2) if self.rig.parallel else views.flip(1, 2)
