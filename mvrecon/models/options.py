"""Options that models share, checked once: what saves work, all off by default, and the network."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from mvrecon.registry import check_options
from mvrecon.visual_hull.support import KINDS

#: Voxels that networks which do not know of the mask see around it.
HALO = 4


@dataclass(frozen=True)
class Options:
    """Which work a model leaves out, and by which network it corrects a volume.

    Args:
        support: where the density may differ from zero, from the views: the visual "hull", its
            "box", "auto" for the hull of a sample if its box is small and else the whole grid, or
            "none" for the whole grid. Work is done on a crop around it, and outside it the density
            is 0 by definition.
        noise: of the views, as `support_from_views` wants it; none for exact views.
        halo: voxels around the support's box that the crop holds, at least 1. With `masked` they
            change nothing: by default there are none then, and else 4.
        masked: the support belongs to the networks too: features are zero and normalisation does
            not look outside it.
        sigma: standard deviation of the views' noise, in their unit; the consistency steps stop
            where it explains what is left. None: every step.
        refine_where: "all" of the support, or bricks of "disagreement" between the opinions.
        tolerance: the opinions' standard deviation, relative to the content's scale, from which on
            they disagree.
        network: in the world, that corrects the volume: `{"name": ..., **options}`; none for
            `UNet3d` of as many channels as the model says.

    Raises:
        ValueError: an unknown choice, a halo below 1, a sigma or a tolerance that is not positive.
    """

    support: str = "none"
    noise: Mapping[str, Any] | None = None
    halo: int | None = None
    masked: bool = True
    sigma: float | None = None
    refine_where: Literal["all", "disagreement"] = "all"
    tolerance: float = 0.1
    network: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        known = {"support": KINDS, "refine_where": ("all", "disagreement")}
        for name, choices in known.items():
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if self.halo is not None and self.halo < 1:
            raise ValueError(f"A crop needs a halo of at least one voxel, got {self.halo}")
        for name in ("sigma", "tolerance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")

    @property
    def margin(self) -> int:
        """Voxels around the support's box that the crop holds."""
        return self.halo if self.halo is not None else 0 if self.masked else HALO

    @classmethod
    def of(cls, model: type, options: Mapping[str, Any]) -> "Options":
        """From what a model was given besides its own parameters.

        Raises:
            TypeError: an option that the model does not have; the message names the nearest, and
                all that it has.
        """
        own = [
            p.name for p in inspect.signature(model).parameters.values() if p.kind != p.VAR_KEYWORD
        ]
        known = {*own, *(field.name for field in fields(cls))}
        check_options("The model", options, known)
        return cls(**options)
