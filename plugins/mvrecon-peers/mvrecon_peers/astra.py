"""ASTRA's 2-D projectors on the CPU, slice by slice (https://astra-toolbox.com; GPLv3, imported
only for use).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, choice, load
from mvrecon_peers.frame import plane_of_rows, require_between

METHODS = ("linear", "line", "strip")


def vectors(rig: Cameras) -> Float[Tensor, "m 6"]:
    """Each view in its plane: ray (or source, for a fan), detector's centre, step between columns;
    x and y of each.

    y is turned round, since ASTRA's first row of pixels is the one of greatest y.
    """
    centre = rig.origin + rig.u * (rig.shape[1] - 1) / 2
    first = rig.origin - rig.source if rig.parallel else rig.source
    upside = torch.tensor([1.0, -1.0]).to(first)
    return torch.cat([points[:, :2] * upside for points in (first, centre, rig.u)], dim=-1)


class Astra(Paired):
    """ASTRA's CPU projectors, matched pairs on one thread: a parallel beam slice by slice, a fan in
    one slice.

    Detector rows must run in the middle planes of slices (or beside the grid); a fan's source lies
    in its slice.

    Args:
        grid: where the voxels lie.
        cameras: the rig.
        method: "line" (Siddon), or for parallel beams "linear" (Joseph) or "strip" (the average
            over a column's width).

    Raises:
        ValueError: an unknown method, a geometry that ASTRA does not take, or cameras that require
            a gradient.
        ImportError: ASTRA is not installed.
    """

    precisions = (torch.float32,)

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "line"):
        super().__init__(grid, cameras)
        self.method = choice("method", method, METHODS)
        self.pairs = plane_of_rows(self.box, self.rig, "ASTRA in 2-D")
        require_between(self.box, self.rig, "ASTRA")
        width, height = self.box.spacing[:2]
        if method != "line" and not self.rig.parallel:
            raise ValueError(
                f"ASTRA's projector {method!r} takes parallel beams, got a fan; use 'line'"
            )
        if abs(width / height - 1) > 1e-4:
            raise ValueError(
                f"ASTRA in 2-D takes square voxels, got {width:.6g} by {height:.6g} mm"
            )
        self.astra = load("astra", "astra-toolbox")
        _, rows, columns = grid.shape
        x, y = columns * width / 2, rows * height / 2
        self.plane = self.astra.create_vol_geom(rows, columns, -x, x, -y, y)
        kind = (
            ("parallel_vec", method) if self.rig.parallel else ("fanflat_vec", f"{method}_fanflat")
        )
        self.fan = self.astra.create_proj_geom(
            kind[0], self.rig.shape[1], vectors(self.rig).numpy()
        )
        self.kind = kind[1]

    def project(self, volume: Float[Tensor, "d h w"]) -> Float[Tensor, "m v u"]:
        """The algorithm FP in every slice that a row sees."""
        x, rows, columns = volume, *self.rig.shape
        views = x.new_zeros(rows, len(self.rig), columns)
        for row, index in self.pairs:
            self._run("FP", x[index], views[row])
        return views.transpose(0, 1)

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """The algorithm BP in every slice that a row sees."""
        y = views.transpose(0, 1).contiguous()
        x = y.new_zeros(self.grid.shape)
        for row, index in self.pairs:
            image = torch.zeros_like(x[index])
            self._run("BP", image, y[row])
            x[index] += image
        return x

    def _run(self, kind: str, image: Tensor, lines: Tensor) -> None:
        """One algorithm, between a slice and its views, in place."""
        astra = self.astra
        volume = astra.data2d.link("-vol", self.plane, image.numpy())
        views = astra.data2d.link("-sino", self.fan, lines.numpy())
        projector = astra.create_projector(self.kind, self.fan, self.plane)
        result = {"FP": "VolumeDataId", "BP": "ReconstructionDataId"}[kind]
        config = astra.astra_dict(kind) | {
            "ProjectorId": projector,
            "ProjectionDataId": views,
            result: volume,
        }
        algorithm = astra.algorithm.create(config)
        astra.algorithm.run(algorithm)
        astra.algorithm.delete(algorithm)
        astra.projector.delete(projector)
        astra.data2d.delete([volume, views])
