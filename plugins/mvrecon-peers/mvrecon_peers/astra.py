"""ASTRA's 2-D projectors on the CPU, slice by slice (https://astra-toolbox.com; GPLv3, imported
only for use).
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import check_choice
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_peers.base import Paired, load
from mvrecon_peers.frame import plane_of_rows, require_between

METHODS = ("linear", "line", "strip")


def vectors(rig: Cameras) -> Float[Tensor, "m 6"]:
    """Vectors of each view in its plane: ray (or source, for a fan), detector centre, column step;
    x and y of each.

    y is reversed, since ASTRA's first row of pixels has the greatest y.
    """
    centre = rig.origin + rig.u * (rig.shape[1] - 1) / 2
    first = rig.origin - rig.source if rig.parallel else rig.source
    upside = torch.tensor([1.0, -1.0]).to(first)
    return torch.cat([points[:, :2] * upside for points in (first, centre, rig.u)], dim=-1)


def turned(rig: Cameras) -> Float[Tensor, " m"]:
    """Angles of parallel views in radians for ASTRA's FBP, whose geometry is `parallel`.

    Raises:
        ValueError: a fan, rays that are not perpendicular to their detector, or a detector that is
            not centred on the axis.
    """
    ray, centre, across = vectors(rig).unflatten(1, (3, 2)).unbind(dim=1)
    pitch = across.norm(dim=1)
    slant = (ray * across).sum(dim=1) / (pitch * ray.norm(dim=1))
    offset = (centre * across).sum(dim=1) / pitch.square()
    if not rig.parallel or max(slant.abs().max(), offset.abs().max()) > 1e-6:
        raise ValueError(
            f"ASTRA's FBP takes parallel beams square to a centred detector, got "
            f"{'parallel beams' if rig.parallel else 'a fan'} slanted by {slant.abs().max():.3g}, "
            f"detectors {offset.abs().max():.3g} columns off"
        )
    return torch.atan2(across[:, 1], across[:, 0])


class Astra(Paired):
    """ASTRA's CPU projectors, matched and single-threaded: parallel beams slice by slice, a fan in
    one slice.

    Detector rows must lie in the central planes of slices (or outside the grid), and a fan's source
    in its slice.

    Args:
        grid: voxels of the volume.
        cameras: the rig.
        method: "line" (Siddon), or for parallel beams "linear" (Joseph) or "strip" (the average
            over a column's width).

    Raises:
        ValueError: an unknown method, a geometry that ASTRA does not support, or cameras that
            require a gradient.
        ImportError: ASTRA is not installed.
    """

    precisions = (torch.float32,)

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "line"):
        super().__init__(grid, cameras)
        check_choice("method", method, METHODS)
        self.method = method
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
        """Apply the algorithm FP to every slice that projects onto a row."""
        x, rows, columns = volume, *self.rig.shape
        views = x.new_zeros(rows, len(self.rig), columns)
        for row, index in self.pairs:
            self._run("FP", x[index], views[row], self.fan)
        return views.transpose(0, 1)

    def backproject(self, views: Float[Tensor, "m v u"]) -> Float[Tensor, "d h w"]:
        """Apply the algorithm BP to every slice that projects onto a row."""
        y = views.transpose(0, 1).contiguous()
        x = y.new_zeros(self.grid.shape)
        for row, index in self.pairs:
            image = torch.zeros_like(x[index])
            self._run("BP", image, y[row], self.fan)
            x[index] += image
        return x

    def reconstruct(
        self,
        kind: str,
        views: Float[Tensor, "m v u"],
        iterations: int = 1,
        options: Mapping[str, Any] | None = None,
    ) -> Float[Tensor, "d h w"]:
        """Reconstruct slices by the named ASTRA algorithm, such as "SIRT", in (unit of the views) /
        mm.
        """
        y = views.transpose(0, 1).contiguous()
        x = y.new_zeros(self.grid.shape)
        fan, pitch = self.fan, self.rig.u[0].norm().item()
        if kind == "FBP":
            angles = turned(self.rig).numpy()
            fan = self.astra.create_proj_geom("parallel", pitch, self.rig.shape[1], angles)
        for row, index in self.pairs:
            self._run(kind, x[index], y[row], fan, iterations, options)
        return x

    def _run(
        self,
        kind: str,
        image: Tensor,
        lines: Tensor,
        fan: Mapping[str, Any],
        iterations: int = 1,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Run one algorithm on a slice and its views, in place."""
        astra = self.astra
        volume = astra.data2d.link("-vol", self.plane, image.numpy())
        views = astra.data2d.link("-sino", fan, lines.numpy())
        projector = astra.create_projector(self.kind, fan, self.plane)
        result = "VolumeDataId" if kind == "FP" else "ReconstructionDataId"
        config = astra.astra_dict(kind) | {
            "ProjectorId": projector,
            "ProjectionDataId": views,
            result: volume,
            "option": dict(options or {}),
        }
        algorithm = astra.algorithm.create(config)
        astra.algorithm.run(algorithm, iterations)
        astra.algorithm.delete(algorithm)
        astra.projector.delete(projector)
        astra.data2d.delete([volume, views])
