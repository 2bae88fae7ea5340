"""A part in a benchmark, and its results and times on one geometry: forward, adjoint and both
gradients.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon_bench.measure import once
from mvrecon_bench.rows import Row, reason

#: The calls in order of execution.
CALLS = ("forward", "adjoint", "volume_grad", "pose_grad")


@dataclass(frozen=True)
class Part:
    """A projector or method to build, and the cases to measure it on.

    Args:
        name: name in its registry.
        options: its options, such as method and backend.
        beam: "central" or "parallel" restricts the part to such rigs; None: the constructor raises
            an error for unsupported rigs.
        largest: maximum number of voxels along an edge.
        only: blocks of a plan to which the part is restricted.
        peer: the part whose time is the divisor.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    beam: str | None = None
    largest: int | None = None
    only: tuple[str, ...] | None = None
    peer: str = ""

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Part":
        """Parse a mapping `{name: ..., beam: ..., largest: ..., only: ..., peer: ..., **options}`.

        Raises:
            ValueError: no name, or an unknown beam.
        """
        options = dict(config)
        own = {
            key: options.pop(key) for key in ("beam", "largest", "only", "peer") if key in options
        }
        if "name" not in options or own.get("beam") not in (None, "central", "parallel"):
            raise ValueError(
                f"A part needs a name, and a beam of central, parallel or none, got {dict(config)}"
            )
        return cls(options.pop("name"), options, **own)

    @property
    def label(self) -> str:
        """A short label, unique per set of options."""
        short = {
            key: str(self.options[key]) for key in ("method", "backend") if key in self.options
        }
        others = (f"{key}={value}" for key, value in self.options.items() if key not in short)
        return " ".join([self.name, *short.values(), *others])

    @property
    def row(self) -> Row:
        """The columns that describe the part."""
        options = json.dumps(dict(self.options), sort_keys=True) if self.options else ""
        method = str(self.options.get("method", ""))
        return {"part": self.name, "method": method, "options": options, "peer": self.peer}

    def takes(self, n: int, parallel: bool, block: str) -> bool:
        """Whether the part supports n voxels along an edge and this kind of rig, in this block of a
        plan.
        """
        fits = self.beam in (None, "parallel" if parallel else "central")
        return fits and n <= (self.largest or n) and (self.only is None or block in self.only)


def part_label(row: Row) -> str:
    """Short label of a row's part."""
    return Part(row["part"], json.loads(row["options"]) if row.get("options") else {}).label


class Trial:
    """A projector, its operands, and notes.

    Args:
        part: the projector to measure.
        grid: grid of the volume.
        cameras: the rig.
        x: volume, with the device and dtype of the trial.
        y: views, the input of the adjoint and the gradients.

    Raises:
        Exception: any error from building the projector.
    """

    def __init__(
        self,
        part: Part,
        grid: Grid,
        cameras: Cameras,
        x: Float[Tensor, "b c d h w"],
        y: Float[Tensor, "b c m v u"],
    ):
        self.part, self.grid, self.cameras, self.x, self.y = part, grid, cameras, x, y
        self.device = str(x.device)
        self.A = self._built(cameras)
        self._poses: tuple[Any, list[Tensor]] | None = None
        self.first_s: dict[str, float] = {}
        self.seconds: dict[str, float] = {}
        self.notes: list[str] = []

    def _built(self, cameras: Cameras) -> Any:
        config = {"name": self.part.name, **self.part.options}
        return PROJECTORS.from_config(config, grid=self.grid, cameras=cameras).to(self.device)

    @property
    def backend(self) -> str:
        """The back end of the last call, if the part reports it."""
        known = (getattr(self.A, name, None) for name in ("last_backend", "backend"))
        return next((backend for backend in known if isinstance(backend, str)), "own")

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
            leaves = [getattr(self.cameras, name).clone().requires_grad_() for name in VECTORS]
            rig = replace(self.cameras, **dict(zip(VECTORS, leaves, strict=True)))
            self._poses = self._built(rig), leaves
        A, leaves = self._poses
        views = A(self.x)
        slopes = torch.autograd.grad(views, leaves, self.y.to(views.dtype), allow_unused=True)
        if all(slope is None for slope in slopes):
            raise NotImplementedError("no gradient reaches the cameras")
        pairs = zip(slopes, leaves, strict=True)
        return [torch.zeros_like(leaf) if slope is None else slope for slope, leaf in pairs]

    def attempt(self, call: str, repeat_s: float) -> Any:
        """The result of a call, with its time in `seconds`; None, with a note, if it fails.

        A call that takes longer than `repeat_s`, for example to compile, is repeated once, and the
        second call counts.
        """
        try:
            result, seconds = once(getattr(self, call), self.device)
            self.first_s.setdefault(call, seconds)
            if seconds > repeat_s:
                result, seconds = once(getattr(self, call), self.device)
        except Exception as error:  # other libraries may raise anything; the benchmark goes on
            self.notes.append(f"{call}: {reason(error)}")
            return None
        self.seconds[call] = seconds
        return result
