"""A projector in a benchmark."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Grid


@dataclass(frozen=True)
class BenchmarkedPart:
    """A projector to build, and the cases to measure it on.

    Args:
        name: name in the registry of projectors.
        options: options of the projector, such as method and backend.
        beam: "central" or "parallel" restricts the part to such rigs; None: the constructor raises
            an error for unsupported rigs.
        largest: maximum number of voxels along an edge.
        only: blocks of a plan to which the part is restricted.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    beam: str | None = None
    largest: int | None = None
    only: tuple[str, ...] | None = None

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "BenchmarkedPart":
        """Parse a mapping `{name: ..., beam: ..., largest: ..., only: ..., **options}`.

        Raises:
            ValueError: no name, or an unknown beam.
        """
        beam, only = config.get("beam"), config.get("only")
        if "name" not in config or beam not in (None, "central", "parallel"):
            raise ValueError(
                f"A part needs a name, and a beam of central, parallel or none, got {dict(config)}"
            )
        options = {
            key: value
            for key, value in config.items()
            if key not in ("name", "beam", "largest", "only")
        }
        return cls(
            config["name"], options, beam, config.get("largest"), tuple(only) if only else None
        )

    @property
    def label(self) -> str:
        """A short label, unique per set of options."""
        others = [
            f"{key}={value}"
            for key, value in self.options.items()
            if key not in ("method", "backend")
        ]
        return " ".join(
            [
                self.name,
                *(str(self.options[k]) for k in ("method", "backend") if k in self.options),
                *others,
            ]
        )

    @property
    def row(self) -> dict[str, str]:
        """The columns that describe the part."""
        options = json.dumps(dict(self.options), sort_keys=True) if self.options else ""
        return {
            "part": self.name,
            "method": str(self.options.get("method", "")),
            "options": options,
        }

    def takes(self, n: int, parallel: bool, block: str) -> bool:
        """Whether the part supports n voxels along an edge and this kind of rig, in this block of a
        plan.
        """
        fits = self.beam in (None, "parallel" if parallel else "central") and n <= (
            self.largest or n
        )
        return fits and (self.only is None or block in self.only)

    def build(self, grid: Grid, cameras: Cameras, device: str = "cpu") -> Any:
        """Build the projector.

        Raises:
            LookupError, ImportError: the projector is not installed.
            ValueError: it does not support the geometry.
        """
        return PROJECTORS.from_config(
            {"name": self.name, **self.options}, grid=grid, cameras=cameras
        ).to(device)
