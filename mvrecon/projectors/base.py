"""What every projector is: a linear operator between the volumes of one grid and the views of one rig."""

from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mvrecon.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.kernels import reference
from mvrecon.kernels.lines import lines_of

METHODS = ("joseph", "siddon")
BACKENDS = ("auto", "cpu", "reference")


class Projector(nn.Module):
    """y = A x: the integrals of volumes along the rays of a rig, in (unit of x) * mm.

    Differentiable in the volume, in the views of the adjoint, and in the cameras' tensors; twice in volume and views.
    Half and bfloat16 input is accumulated, and given back, in float32. Geometry stays in float64 whatever the module is
    cast to. Grid and cameras stay where they were made; `.to(device)` moves the operator.

    Args:
        grid: where the voxels lie.
        cameras: the rig.
        method: "joseph", second order in the voxel size for smooth volumes, first across sharp edges, with a step where
            a ray's main axis changes; or "siddon", exact for volumes of constant voxels, first order otherwise.
        backend: "cpu" (compiled), "reference" (torch, any device and order of derivative), or "auto": cpu for tensors
            in main memory where numba is installed, else reference.

    Raises:
        ValueError: an unknown method or back end, or grid and cameras on different devices.
    """

    def __init__(self, grid: Grid, cameras: Cameras, method: str = "joseph", backend: str = "auto"):
        super().__init__()
        for what, name, known in (("method", method, METHODS), ("backend", backend, BACKENDS)):
            if name not in known:
                raise ValueError(f"Unknown {what} {name!r}. Known: {', '.join(known)}")
        if cameras.source.device != grid.affine.device:
            raise ValueError(
                f"Grid and cameras must be on one device, got {grid.affine.device} and {cameras.source.device}"
            )
        self.grid, self.cameras, self.method, self.backend = grid, cameras, method, backend
        self.window = list(cameras.limits)
        lines = lines_of(cameras, grid)
        self.poses = lines.requires_grad
        self.register_buffer("fixed_lines", lines.detach(), persistent=False)

    def _apply(self, fn, recurse: bool = True):
        exact = self.fixed_lines
        super()._apply(fn, recurse)
        self.fixed_lines = exact.to(self.fixed_lines.device)
        return self

    @property
    def lines(self) -> Float[Tensor, "m 4 3 3"]:
        """The rays in voxel space; made anew, with their graph, where the cameras want a gradient."""
        return lines_of(self.cameras, self.grid).to(self.fixed_lines.device) if self.poses else self.fixed_lines

    def forward(self, volume: Float[Tensor, "b c d h w"]) -> Float[Tensor, "b c m v u"]:
        """Views of volumes.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        check(volume, "a volume [b c d h w]", self.grid.shape, self.fixed_lines.device)
        x = _wide(volume).flatten(0, 1)
        views = self._kernels(x).project(x, self.lines, self.window, list(self.cameras.shape), self.method)
        return views.unflatten(0, volume.shape[:2])

    @property
    def T(self) -> Callable[[Float[Tensor, "b c m v u"]], Float[Tensor, "b c d h w"]]:
        """The matched adjoint: <A x, y> = <x, A.T(y)>."""
        return self.adjoint

    def adjoint(self, views: Float[Tensor, "b c m v u"]) -> Float[Tensor, "b c d h w"]:
        """Volumes from views: every value spread along its ray with the weights of `forward`.

        Raises:
            ValueError: a wrong rank, size or device.
        """
        check(views, "views [b c m v u]", (len(self.cameras), *self.cameras.shape), self.fixed_lines.device)
        y = _wide(views).flatten(0, 1)
        volume = self._kernels(y).backproject(y, self.lines, self.window, list(self.grid.shape), self.method)
        return volume.unflatten(0, views.shape[:2])

    def _kernels(self, tensor: Tensor) -> ModuleType:
        compiled = tensor.device.type == "cpu" and find_spec("numba") is not None
        if self.backend == "reference" or (self.backend == "auto" and not compiled):
            return reference
        if tensor.device.type != "cpu":
            raise ValueError(
                f"backend 'cpu' needs tensors in main memory, got {tensor.device}; use 'auto' or 'reference'"
            )
        from mvrecon.kernels import ops  # numba is heavy and only this back end needs it

        return ops

    def extra_repr(self) -> str:
        return (
            f"{len(self.cameras)} views of {self.cameras.shape}, grid {self.grid.shape}, {self.method}, {self.backend}"
        )


def _wide(tensor: Tensor) -> Tensor:
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


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
