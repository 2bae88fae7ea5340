"""A projector on one geometry: results and times of forward, adjoint and both gradients."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_bench.benchmarks.measure import once, with_memory
from mvrecon_bench.benchmarks.part import BenchmarkedPart

#: The calls in order of execution.
CALLS = ("forward", "adjoint", "volume_grad", "pose_grad")


class Trial:
    """A part, its operands, and notes.

    Args:
        part: the part to measure.
        grid: grid of the volume.
        cameras: the rig.
        x: volume, with the device and dtype of the trial.
        y: views, the input of the adjoint and the gradients.

    Raises:
        Exception: any error from building the part.
    """

    def __init__(
        self,
        part: BenchmarkedPart,
        grid: Grid,
        cameras: Cameras,
        x: Float[Tensor, "b c d h w"],
        y: Float[Tensor, "b c m v u"],
    ):
        self.part, self.grid, self.cameras, self.x, self.y = part, grid, cameras, x, y
        self.device = str(x.device)
        self.A = part.build(grid, cameras, self.device)
        self._poses: tuple[Any, list[Tensor]] | None = None
        self.first_s: dict[str, float] = {}
        self.seconds: dict[str, float] = {}
        self.notes: list[str] = []

    @property
    def backend(self) -> str:
        """The back end of the last call, if the part reports it."""
        for name in ("last_backend", "backend"):
            if isinstance(backend := getattr(self.A, name, None), str):
                return backend
        return "own"

    @torch.no_grad()
    def forward(self) -> Tensor:
        """y = A x."""
        return self.A(self.x)

    @torch.no_grad()
    def adjoint(self) -> Tensor:
        """A^T y."""
        return self.A.T(self.y)

    def volume_grad(self) -> Tensor:
        """Forward, and backward to the volume."""
        x = self.x.detach().requires_grad_()
        views = self.A(x)
        return torch.autograd.grad(views, x, self.y.to(views.dtype))[0]

    def pose_grad(self) -> list[Tensor]:
        """Forward, and backward to the cameras' source, origin, u and v, each [m 3]."""
        if self._poses is None:
            leaves = [
                getattr(self.cameras, name).detach().clone().requires_grad_() for name in VECTORS
            ]
            rig = replace(self.cameras, **dict(zip(VECTORS, leaves, strict=True)))
            self._poses = self.part.build(self.grid, rig, self.device), leaves
        A, leaves = self._poses
        views = A(self.x)
        gradients = torch.autograd.grad(views, leaves, self.y.to(views.dtype), allow_unused=True)
        if all(g is None for g in gradients):
            raise NotImplementedError("no gradient reaches the cameras")
        return [
            torch.zeros_like(leaf) if g is None else g
            for g, leaf in zip(gradients, leaves, strict=True)
        ]

    def attempt(self, call: str, forecast_s: float, repeat_s: float, limit_s: float) -> Any:
        """The result of a call, with its time in `seconds`; None, with a note, if it fails.

        A call that takes longer than `repeat_s`, for example to compile, is repeated once, and the
        second call counts; a call that is expected to exceed `limit_s` is skipped.
        """
        if forecast_s > limit_s:
            self.notes.append(
                f"{call} left out: about {forecast_s:.0f} s expected, limit {limit_s:g} s"
            )
            return None
        try:
            result, seconds = once(getattr(self, call), self.device)
            self.first_s.setdefault(call, seconds)
            if seconds > repeat_s:
                result, seconds = once(getattr(self, call), self.device)
        except (
            Exception
        ) as error:  # other libraries may raise anything; it must not end the benchmark
            self.notes.append(f"{call}: {reason(error)}")
            return None
        self.seconds[call] = seconds
        return result

    def again(self, call: str) -> tuple[Any, float]:
        """The result of another run, and its memory in MB."""
        return with_memory(getattr(self, call), self.device)


def reason(error: BaseException) -> str:
    """Format an exception in one short line."""
    text = next((line for line in str(error).splitlines() if line.strip()), "no message")
    return f"{type(error).__name__}: {text.strip()}"[:240]


def expected(seconds: Mapping[str, float], call: str, forecast: Mapping[str, float]) -> float:
    """Expected duration of a call: extrapolated from a smaller case, and at least that of its
    components.
    """
    made_of = {
        "volume_grad": ("forward", "adjoint"),
        "pose_grad": ("forward", "forward", "forward"),
    }
    return max(
        forecast.get(call, 0.0), sum(seconds.get(piece, 0.0) for piece in made_of.get(call, ()))
    )
