"""Explicit rays: two points in mm for every pixel, for detectors that are not flat (curved
detectors, converging collimators, lines of response).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ExplicitRays:
    """The segments from source to target of every pixel of M detectors; a projector takes them
    instead of cameras.

    The points are copied, but for tensors that require a gradient. A ray takes 96 bytes more than
    its two points. For a flat detector `Cameras` is smaller and
    faster.

    Args:
        source: where each ray begins, in world mm.
        target: where it ends, in world mm.

    Raises:
        ValueError: shapes that do not agree, values that are not finite, a ray without length.
    """

    source: Float[Tensor, "m v u 3"]
    target: Float[Tensor, "m v u 3"]

    #: What it shares with `Cameras`.
    parallel = None
    ray_extent = (0.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("source", "target"):
            points = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            points = points if points.requires_grad else points.clone()
            object.__setattr__(self, name, points)
            if points.ndim != 4 or points.shape[3] != 3 or not points.numel():
                raise ValueError(
                    f"Explicit rays need {name} as [m v u 3], got {list(points.shape)}"
                )
            if not points.isfinite().all():
                raise ValueError(
                    f"Explicit rays need finite mm, but {name} holds values that are NaN or "
                    f"infinite"
                )
        sizes = [(list(points.shape), str(points.device)) for points in (self.source, self.target)]
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"Explicit rays need source and target of one shape on one device, got {sizes}"
            )
        short = (self.source == self.target).all(dim=-1)
        if short.any():
            raise ValueError(
                f"Explicit rays need two different ends, but {int(short.sum())} have no length"
            )

    def __len__(self) -> int:
        return len(self.source)

    @property
    def shape(self) -> tuple[int, int]:
        """Detector pixels (rows, columns)."""
        return self.source.shape[1], self.source.shape[2]

    def rays(self) -> tuple[Float[Tensor, "m v u 3"], Float[Tensor, "m v u 3"]]:
        """Where each pixel's ray begins and where it ends, in world mm."""
        return self.source, self.target
