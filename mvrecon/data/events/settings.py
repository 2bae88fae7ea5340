"""Options of a data set of events, with their meaning."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from mvrecon.registry import check_options


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """How many events there are, in which files, and what is kept of each.

    Args:
        count: of events.
        first: index of the first one in its series; other folders may go on where one ends.
        shard: events in a file; the last one may have fewer.
        workers: processes that make shards beside this one, 0: none. No byte depends on it.
        totals: least and greatest expected counts of an event, its own drawn between them, uniform
            in the logarithm. None: `acquisition.counts` for all.
        angles: of the sinograms over the full circle; 0: none are kept.
        bins: of the sinograms; None: enough for the diagonal of a slice.
        backprojection: whether the counts' back-projection is kept, too.

    Raises:
        TypeError: an option that is no number.
        ValueError: numbers that are too small.
    """

    count: int
    first: int = 0
    shard: int = 32
    workers: int = 2
    totals: tuple[float, float] | None = None
    angles: int = 256
    bins: int | None = None
    backprojection: bool = False

    def __post_init__(self) -> None:
        least = {"count": 1, "first": 0, "shard": 1, "workers": 0, "angles": 0, "bins": 1}
        for name, value in asdict(self).items():
            if name in ("totals", "backprojection") or (name == "bins" and value is None):
                continue
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"Expected events.{name} as a whole number, got {value!r}")
            if value < least[name]:
                raise ValueError(f"Expected events.{name} of at least {least[name]}, got {value}")
        if self.totals is not None:
            low, high = self.totals
            if not 0 < low <= high < float("inf"):
                raise ValueError(f"Expected events.totals that ascend above 0, got {low}, {high}")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "EventSettings":
        """The settings that a mapping describes.

        Raises:
            TypeError: an unknown option, or one without a default that is missing.
        """
        check_options("A data set of events", options, [field.name for field in fields(cls)])
        values = dict(options)
        if values.get("totals") is not None:
            values["totals"] = tuple(float(total) for total in values["totals"])
        return cls(**values)

    @property
    def shards(self) -> int:
        """How many files there are."""
        return -(-self.count // self.shard)

    def indices(self, shard: int) -> range:
        """Indices, in their series, of the events in a file."""
        start = self.first + shard * self.shard
        return range(start, min(start + self.shard, self.first + self.count))
