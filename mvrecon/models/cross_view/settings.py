"""Options of the rounds of a model, checked once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, Self, get_args

from mvrecon.models.cross_view.evidence import Task
from mvrecon.models.cross_view.unet import Precision
from mvrecon.registry import check_options

#: Voxels of a cell along each axis, by the resolution of a round.
EDGES = {"quarter": 4, "half": 2, "full": 1}


def _check_resolution(what: str, resolution: str) -> None:
    if resolution not in EDGES:
        raise ValueError(
            f"Expected the resolution of {what} as {', '.join(EDGES)}, got {resolution!r}"
        )


def _check_widths(what: str, widths: Sequence[int]) -> None:
    if not widths or min(widths) < 1:
        raise ValueError(f"Expected the widths of {what} as positive numbers, got {widths}")


class Checked:
    """Dataclass that is made from a mapping; `what` begins the message of an unknown option."""

    what: ClassVar[str]

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """The options of a mapping.

        Raises:
            TypeError: an unknown option; the message gives the nearest and all.
        """
        check_options(cls.what, options, (one.name for one in fields(cls)))  # type: ignore[arg-type]
        return cls(**options)


@dataclass(frozen=True)
class OpinionOptions(Checked):
    """How the opinions of a round are formed and compared.

    Args:
        resolution: of each camera's volume and weights, "quarter", "half" or "full"; none for the
            round's.
        head: `{name: ..., **options}`; from logits along a ray to the density there.
        features: channels that a camera hands to the network in the world besides its density.
        fusion: "weighted" by a network over the cameras, or the plain "mean".
        widths: channels of each scale of that network, the finest first.
        weigh_rays: whether the residual of each ray counts by the weight of its camera along it.
        places: along the rays: "residual": what the corrected view has more than that of x; "view":
            the whole view, with the errors of coarse cells and bins along a ray in it.
        prior: "learned": the cameras' network moves the density of x along the rays; "uniform": no
            network, all depths equally likely.

    Raises:
        ValueError: an unknown resolution, fusion, places or prior, no scale, a width below 1, or
            less than no feature.
    """

    what: ClassVar[str] = "The opinion of a round"

    resolution: Literal["quarter", "half", "full"] | None = None
    head: Mapping[str, Any] = field(default_factory=lambda: {"name": "softmax_depth"})
    features: int = 4
    fusion: Literal["weighted", "mean"] = "weighted"
    widths: Sequence[int] = (8, 16)
    weigh_rays: bool = False
    places: Literal["residual", "view"] = "residual"
    prior: Literal["learned", "uniform"] = "learned"

    def __post_init__(self) -> None:
        if self.resolution is not None:
            _check_resolution("opinions", self.resolution)
        if self.fusion not in ("weighted", "mean"):
            raise ValueError(f"Expected the fusion weighted or mean, got {self.fusion!r}")
        if self.places not in ("residual", "view"):
            raise ValueError(f"Expected places as residual or view, got {self.places!r}")
        if self.prior not in ("learned", "uniform"):
            raise ValueError(f"Expected the prior learned or uniform, got {self.prior!r}")
        _check_widths("the network that weighs opinions", self.widths)
        if self.features < 0:
            raise ValueError(f"Expected features of at least 0, got {self.features}")

    @property
    def learned(self) -> bool:
        """Whether the cameras' network moves density along the rays."""
        return self.prior == "learned"

    @property
    def weighted(self) -> bool:
        """Whether a network weighs the opinions."""
        return self.fusion == "weighted"

    @property
    def handed(self) -> int:
        """Channels of features that a camera's network gives."""
        return self.features if self.learned else 0


@dataclass(frozen=True)
class RoundOptions(Checked):
    """One round's resolution, widths, cameras and opinions.

    Args:
        resolution: of the network in the world: "quarter", "half", cells of 64 or of 8 voxels as
            its channels, or "full".
        widths: channels of each of its scales, the finest first.
        cameras: the cameras' network: `{name: ..., correct: true, shared: true, **options}`:
            whether it corrects the views, and is one for all cameras or one each; none for a
            round in the world alone.
        opinions: fields of `OpinionOptions`, for a round with cameras; none for none.

    Raises:
        ValueError: an unknown resolution, no scale, a width below 1, opinions without cameras or
            of voxels that the network in the world has not, or cameras that have nothing to do.
    """

    what: ClassVar[str] = "A round"

    resolution: Literal["quarter", "half", "full"] = "half"
    widths: Sequence[int] = (32, 48, 64)
    cameras: Mapping[str, Any] | None = None
    opinions: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        _check_resolution("a round", self.resolution)
        _check_widths("a round", self.widths)
        if self.cameras is None and self.opinions is not None:
            raise ValueError("Expected opinions in a round with cameras, got cameras: null")
        if self.judged is not None and self.scale not in range(len(self.widths)):
            raise ValueError(
                "Expected opinions of the resolution of one of the scales of the round's network, "
                f"got {self.judged.resolution} where {len(self.widths)} begin at {self.resolution}"
            )
        if self.cameras is not None and not (self.corrects or self.task.logits):
            raise ValueError(
                "Expected cameras that correct views or have opinions with a learned prior, got "
                "neither"
            )

    @property
    def edge(self) -> int:
        """Voxels of a cell along each axis."""
        return EDGES[self.resolution]

    @property
    def judged(self) -> OpinionOptions | None:
        """The options of the opinions, where there are any."""
        return None if self.opinions is None else OpinionOptions.of(self.opinions)

    @property
    def scale(self) -> int:
        """Scale of the network in the world whose voxels opinions have: 0, the finest, where they
        have the round's resolution.
        """
        chosen = self.judged.resolution if self.judged else None
        return EDGES[chosen or self.resolution].bit_length() - self.edge.bit_length()

    @property
    def corrects(self) -> bool:
        """Whether the cameras correct their views."""
        return self.cameras is not None and bool(self.cameras.get("correct", True))

    @property
    def network(self) -> Mapping[str, Any]:
        """Name and own options of the cameras' network."""
        options = dict(self.cameras or {})
        return {name: value for name, value in options.items() if name not in ("correct", "shared")}

    @property
    def task(self) -> Task:
        """What the round asks of its cameras' network."""
        shared = bool((self.cameras or {}).get("shared", True))
        opinions = self.judged
        if opinions is None:
            return Task(self.corrects, shared)
        logits = 1 + opinions.weighted if opinions.learned else 0
        return Task(self.corrects, shared, logits, opinions.handed)


@dataclass(frozen=True)
class Computing(Checked):
    """How the networks of the rounds compute, on which part of the grid, and whether one more tells
    how far the volume may be off.

    Args:
        precision: of the convolutions, "float32", or "auto": bfloat16 where the processor has
            instructions for it.
        crop: whether the networks in the world see no more of the grid than the box around a
            sample's support, with a margin of 4 voxels.
        uncertainty: whether a network estimates the standard deviation of each voxel's error.

    Raises:
        ValueError: an unknown precision.
    """

    what: ClassVar[str] = "The model"

    precision: Precision = "float32"
    crop: bool = False
    uncertainty: bool = False

    def __post_init__(self) -> None:
        if self.precision not in get_args(Precision):
            raise ValueError(f"Expected the precision float32 or auto, got {self.precision!r}")


#: Cameras correct at full resolution, place and weigh at a quarter of it.
ROUNDS: tuple[Mapping[str, Any], ...] = (
    {
        "resolution": "full",
        "widths": (16, 32, 64),
        "cameras": {"name": "rays2d"},
        "opinions": {"resolution": "quarter", "widths": (8,), "weigh_rays": True},
    },
)
