"""What every projector is: a linear operator between the volumes of one grid and the views of one rig."""

import math
from collections.abc import Callable
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from mvrecon.cameras.camera import Cameras
from mvrecon.cameras.explicit import ExplicitRays
from mvrecon.geometry.grid import Grid
from mvrecon.kernels import backends
from mvrecon.kernels.backends import wide
from mvrecon.kernels.rays import reference
from mvrecon.kernels.rays.lines import lines_of, lines_of_rays

METHODS = ("joseph", "siddon", "trilinear")


class Projector(nn.Module):
    """y = A x: the integrals of volumes along the rays of a rig, in (unit of x) * mm.

    Differentiable in the volume, in the views of the adjoint, and in the cameras' tensors; twice in volume and views.
    Half and bfloat16 volumes are read as they are and summed in float32, which views and adjoints are given back in.
    Geometry stays in float64 whatever the module is cast to. Grid and cameras stay where they were made;
    `.to(device)` moves the operator. `last_backend` tells which back end did the last call.

    Args:
        grid: where the voxels lie.
        cameras: the rig, or rays given one by one.
        method: "joseph", second order in the voxel size for smooth volumes, first across sharp edges, with a step where
            a ray's main axis changes; "siddon", exact for volumes of constant voxels, first order otherwise; or
            "trilinear", second order in the distance of its samples too, and dearer than "joseph" at no gain.
        backend: "cpu" (compiled), "cuda" (compiled), "reference" (torch, any device and order of derivative), or
            "auto": the compiled one of the tensors' device where it can be had, else reference.
        samples: of "trilinear", on each ray; by default as many as voxels fit along the grid's diagonal.
        rays_per_pixel: a pixel is the mean over so many rays each way (1: the thin ray at its centre).

    Raises:
        ValueError: an unknown method or back end, counts below one, samples for another method, or grid and cameras on
            different devices.
    """

    def __init__(
        self,
        grid: Grid,
        cameras: Cameras | ExplicitRays,
        method: str = "joseph",
        backend: str = "auto",
        samples: int | None = None,
        rays_per_pixel: int = 1,
    ):
        super().__init__()
        for what, name, known in (("method", method, METHODS), ("backend", backend, backends.BACKENDS)):
            if name not in known:
                raise ValueError(f"Unknown {what} {name!r}. Known: {', '.join(known)}")
        if cameras.source.device != grid.affine.device:
            raise ValueError(
                f"Grid and cameras must be on one device, got {grid.affine.device} and {cameras.source.device}"
            )
        self.grid, self.rays, self.method, self.backend = grid, cameras, method, backend
        self.samples, self.rays_per_pixel = _samples(samples, method, grid), rays_per_pixel
        self.last_backend: str | None = None
        self.window = list(cameras.limits)
        lines = self._lines()
        self.poses = lines.requires_grad
        self.register_buffer("fixed_lines", lines.detach(), persistent=False)

    @property
    def cameras(self) -> Cameras:
        """The rig.

        Raises:
            ValueError: the rays were given one by one, and have no cameras with frusta.
        """
        if isinstance(self.rays, ExplicitRays):
            raise ValueError("This needs cameras, which the projector has not: it was given explicit rays")
        return self.rays

    def _lines(self) -> Float[Tensor, "m 4 3 k"]:
        if isinstance(self.rays, ExplicitRays):
            if self.rays_per_pixel != 1:
                raise ValueError(f"Explicit rays are one a pixel, got rays_per_pixel={self.rays_per_pixel}")
            return lines_of_rays(self.rays, self.grid)
        return lines_of(self.rays.refined(self.rays_per_pixel), self.grid)

    def _apply(self, fn, recurse: bool = True):
        exact = self.fixed_lines
        super()._apply(fn, recurse)
        self.fixed_lines = exact.to(self.fixed_lines.device)
        return self

    @property
    def lines(self) -> Float[Tensor, "m 4 3 k"]:
        """The rays in voxel space; made anew, with their graph, where the cameras want a gradient."""
        return self._lines().to(self.fixed_lines.device) if self.poses else self.fixed_lines

    @property
    def _detector(self) -> list[int]:
        """Rays (rows, columns) of one of the views that `lines` describes."""
        explicit = isinstance(self.rays, ExplicitRays)
        return [1, 1] if explicit else [n * self.rays_per_pixel for n in self.rays.shape]

    @property
    def _kernel(self) -> str:
        return self.method if self.samples is None else f"{self.method}:{self.samples}"

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        check(volume, "a volume [b c d h w]", self.grid.shape, self.fixed_lines.device)
        x, kernels = volume.flatten(0, 1), self._kernels(volume)
        x = wide(x) if kernels is reference else x
        views = kernels.project(x, self.lines, self.window, self._detector, self._kernel)
        if self.rays_per_pixel > 1:
            views = avg_pool2d(views, self.rays_per_pixel)
        return views.reshape(*volume.shape[:2], len(self.rays), *self.rays.shape)

    @property
    def T(self) -> Callable[[Float[Tensor, "b c m v u"]], Float[Tensor, "b c d h w"]]:
        """The matched adjoint: <A x, y> = <x, A.T(y)>."""
        return self.adjoint

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from views: every value spread along its ray with the weights of `forward`.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        check(views, "views [b c m v u]", (len(self.rays), *self.rays.shape), self.fixed_lines.device)
        y, r = wide(views).flatten(0, 1), self.rays_per_pixel
        if r > 1:
            y = (y / r**2).repeat_interleave(r, dim=2).repeat_interleave(r, dim=3)
        y = y.reshape(len(y), len(self.fixed_lines), *self._detector)
        volume = self._kernels(y).backproject(y, self.lines, self.window, list(self.grid.shape), self._kernel)
        return volume.unflatten(0, views.shape[:2])

    def _kernels(self, tensor: Tensor) -> ModuleType:
        chosen, kernels = backends.kernels_for(tensor, self.backend, self._kernel)
        self.last_backend = chosen
        return kernels

    def extra_repr(self) -> str:
        return f"{len(self.rays)} views of {self.rays.shape}, grid {self.grid.shape}, {self.method}, {self.backend}"


def _samples(samples: int | None, method: str, grid: Grid) -> int | None:
    if method != "trilinear":
        if samples is not None:
            raise ValueError(f"samples={samples} goes with method 'trilinear', got {method!r}")
        return None
    if samples is None:
        return math.ceil(math.hypot(*grid.shape))
    if samples < 1:
        raise ValueError(f"A ray needs a positive number of samples, got {samples}")
    return samples


def check(tensor: Tensor, what: str, sizes: tuple[int, ...], device: torch.device) -> None:
    """Raise ValueError unless a tensor [b c ...] has these last sizes and lies on the device."""
    if tensor.ndim != 5 or tuple(tensor.shape[2:]) != tuple(sizes):
        raise ValueError(f"Expected {what} with last sizes {tuple(sizes)}, got {tuple(tensor.shape)}")
    if tensor.device != device:
        raise ValueError(f"Expected {what} on {device}, where the projector is, got {tensor.device}")


def check_views(views: Float[Tensor, "b c m v u"], cameras: Cameras) -> None:
    """The door for measured views.

    Raises:
        ValueError: a wrong rank or size, or values that are not finite.
    """
    check(views, "views [b c m v u]", (len(cameras), *cameras.shape), views.device)
    if not views.isfinite().all():
        bad = int((~views.isfinite()).sum())
        raise ValueError(f"Views must be finite, got {bad} of {views.numel()} values that are NaN or infinite")
