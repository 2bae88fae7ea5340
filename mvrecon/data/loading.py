"""How the cases of a run are made and put into batches."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from mvrecon.quantities import NonNegativeInt, PositiveInt
from mvrecon.registry import check_options


@dataclass(frozen=True)
class Loading:
    """How cases are made and put into batches.

    Args:
        batch_size: cases in a batch.
        workers: processes that make the cases before training, and load batches.
        cache: folder in which cases are kept from run to run, without their noise; None: they are
            made anew by every run. All cases of a run are kept in memory either way.
        rigs: rigs that measure the training cases, of a camera with a `seed`, those of the seeds
            that follow its own; 0: its own rig, as validation and test have.

    Raises:
        ValueError: a number that is too small.
    """

    batch_size: PositiveInt = 1
    workers: NonNegativeInt = 0
    cache: str | None = None
    rigs: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if self.batch_size < 1 or min(self.workers, self.rigs) < 0:
            raise ValueError(
                f"Expected a batch_size of at least 1 and workers and rigs of at least 0, got "
                f"{self.batch_size}, {self.workers} and {self.rigs}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "Loading":
        """The options of a mapping.

        Raises:
            TypeError: an unknown option; the message gives the nearest and all.
        """
        check_options("data", options, (field.name for field in fields(cls)))
        return cls(**options)
