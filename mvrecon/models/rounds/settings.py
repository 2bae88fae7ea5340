"""Options of the rounds of a model, checked once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from mvrecon.registry import hint

#: Voxels of a cell along each axis, by the resolution of a round.
EDGES = {"half": 2, "full": 1}


@dataclass(frozen=True)
class RoundOptions:
    """One round's resolution, widths and cameras.

    Args:
        resolution: of the network in the world: "half", cells of 8 voxels as its channels, or
            "full".
        widths: channels of each of its scales, the finest first.
        cameras: the cameras' network that corrects the views before: `{name: ..., **options}`;
            none for a round in the world alone.

    Raises:
        ValueError: an unknown resolution, no scale, or a width below 1.
    """

    resolution: Literal["half", "full"] = "half"
    widths: Sequence[int] = (32, 48, 64)
    cameras: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.resolution not in EDGES:
            raise ValueError(
                f"Expected the resolution of a round as half or full, got {self.resolution!r}"
            )
        if not self.widths or min(self.widths) < 1:
            raise ValueError(
                f"Expected the widths of a round as positive numbers, got {self.widths}"
            )

    @property
    def edge(self) -> int:
        """Voxels of a cell along each axis."""
        return EDGES[self.resolution]

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "RoundOptions":
        """The options of a mapping.

        Raises:
            TypeError: an unknown option; the message gives the nearest and all.
        """
        known = [field.name for field in fields(cls)]
        for option in options:
            if option not in known:
                raise TypeError(f"A round has no option {option!r}{hint(str(option), known)}")
        return cls(**options)


#: Two rounds at half resolution, the first with the cameras' network, and one at full resolution.
ROUNDS: tuple[Mapping[str, Any], ...] = (
    {"resolution": "half", "widths": (32, 48, 64), "cameras": {"name": "rays2d"}},
    {"resolution": "half", "widths": (32, 48, 64)},
    {"resolution": "full", "widths": (16, 32, 64)},
)
