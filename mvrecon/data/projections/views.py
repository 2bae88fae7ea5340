"""Measured views as line integrals, corrected when read, on a region of the detector."""

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mvrecon.core.files.checks import Refused, shown
from mvrecon.core.files.keys import warn_of_unknown
from mvrecon.core.machine import check_memory
from mvrecon.data.projections.faults import (
    FEWEST_VIEWS,
    SAMPLED_VIEWS,
    Fields,
    fields,
    filled,
    in_words,
    transmissions,
    wrong_in_views,
    zingers,
)
from mvrecon.data.projections.linearise import linearised
from mvrecon.data.projections.opening import (
    bad_pixels,
    exposures,
    mean_field,
    open_projections,
)
from mvrecon.data.projections.options import Kind, Measured
from mvrecon.data.projections.rings import without_rings
from mvrecon.data.projections.stack import READ_PIXELS, Region
from mvrecon.geometry.cameras.camera import Cameras

#: Share of the pixels that views alone may show to be wrong.
MAX_WRONG = 0.1
#: Units of logarithms and of attenuation.
LOGARITHMS = re.compile(
    r"hounsfield|^hu$|hnsf|absor(?!bed)|\bm?abs\b|optical.?de(ns|p)|^od$|extinct|attenuat|"
    r"line.?integral|^projections?$|"
    r"(?<![a-z])((neg|minus)[ _-]?)?(ln|lg|log(arithm(ic)?)?)(10|2|e)?(?![a-z])|"
    r"^(1 ?/|/|per) ?[cmnuµ]?m\b|\b[cmnuµ]?m ?(\^|\*\*)?\{?[-⁻][1¹]",
    re.IGNORECASE,
)
#: Units of each kind that need no factor, as another base of logarithms, a length or a rate does.
PLAIN_UNITS = {
    "integrals": re.compile(
        r"|1|1/mm \* mm|none|(unit|dimension)less|a\.? ?u\.?|arb.*|.*\bln\b.*|(neg|minus)[ _-]?log|"
        r"(line.?)?integrals?|(linear )?attenuation|absorption|projections?|optical depth|nepers?",
        re.IGNORECASE,
    ),
    "counts": re.compile(r"|1|none|(unit|dimension)less|counts?|cnts?|photons?|events?", re.I),
}
#: Line integrals below this are more than an imperfect flat field: 5 % brighter than it.
NEGATIVE = -0.05
#: Line integrals above this in all pixels but some are those of views a tenth as bright as their
#: flat field; and the share of these pixels.
DIM, BRIGHT = math.log(10), 1e-3
#: Views before and after each that zingers of one or two rows are compared with.
ADJACENT = 2
#: Rows that make an image of a view.
ROWS_OF_IMAGES = 5
#: Pixels corrected at a time, so that intermediate values stay in a processor's cache.
CORRECTED_PIXELS = 2**20


@dataclass(frozen=True, eq=False)
class Corrected:
    """Views as line integrals.

    Args:
        views: line integrals, float32 (or the stored values, if not grey values).
        mask: measured pixels, no part of which is dead or saturated.
        odd: numbers of pixels by name: "saturated", before binning; "floored", whose transmission
            was at most the floor; "zingers", bright in a single view; "unread", which a file marks
            as bad in a view; "negative", line integrals below `NEGATIVE`; and "dim", above `DIM`.
    """

    views: Float[Tensor, "m v u"]
    mask: Bool[Tensor, "m v u"]
    odd: Counter[str] = field(default_factory=Counter)


class MeasuredViews:
    """Views of one measurement as line integrals, corrected when read.

    Args:
        options: options of the files and of their correction.

    Warns:
        UserWarning: keys of the files that no reader knows and that may change values; at the first
            reading, pixels that measure wrongly, with their places.

    Raises:
        FileNotFoundError, ImportError: see `open_projections`.
        Refused: as there; an incompatible kind, no flat field, a field of another size or not above
        the dark one.
    """

    def __init__(self, options: Measured):
        own = (options.dark, options.flat)
        names = {name: getattr(options, name) for name in ("dataset", "angles", "image_key")}
        stack = open_projections(
            options.path, options.pattern, options.gaps, own, options.layout, **names
        )
        self.options, self.stack = options, stack
        self.region = Region(stack.shape, options.rows, options.columns, options.binning)
        whole = stack.dtype.kind != "f"
        if options.kind == "integrals" and whole:
            raise Refused(
                f"{options.path}: expected floats for line integrals, got pixels of "
                f"{stack.dtype}; kind=intensities (views.kind) is for grey values, kind=counts for "
                f"emission"
            )
        kind = options.kind or stack.kind or ("intensities" if whole else None)
        if kind is None:
            raise Refused(
                f"{options.path}: expected kind=integrals or kind=intensities (views.kind) for "
                f"pixels of {stack.dtype}, which may be either, as those that a file scales "
                f"(kind=counts: emission), got none"
            )
        if kind != "integrals" and LOGARITHMS.search(stack.units):
            wanted = "intensities beside flat fields" if kind == "intensities" else kind
            raise Refused(
                f"{options.path}: expected units of {wanted}, got {shown(stack.units)}; if they "
                f"are right, say kind=integrals (views.kind), and views.dataset=<name> of a file "
                f"without flat fields"
            )
        other = kind in PLAIN_UNITS and not PLAIN_UNITS[kind].fullmatch(stack.units)
        unknown = [name for name in stack.unknown if name not in options.used]
        warn_of_unknown(stack.path, [*unknown, *[f"units={stack.units}"] * other])
        if kind == "counts" and options.linearise is not None:
            raise Refused(
                f"{options.path}: expected line integrals or intensities for views.linearise, got "
                f"counts"
            )
        self.kind: Kind = kind
        if kind == "counts" and options.rings is not None:
            raise Refused(f"{options.path}: expected line integrals for rings, got counts")
        few = self.n_views < FEWEST_VIEWS or self.shape[1] <= 2 * options.ring_width
        if options.rings is not None and few:
            raise Refused(
                f"{options.path}: expected at least {FEWEST_VIEWS} views of more than "
                f"{2 * options.ring_width} columns for rings, got {self.n_views} of {self.shape[1]}"
            )
        self.gains: Float[Tensor, " m"] | None = None
        self.exposure: Float[Tensor, " m"] | None = None
        of_light = ("exposure", "flat", "dark", "saturation")
        if kind != "intensities" and (given := [x for x in of_light if getattr(options, x)]):
            raise Refused(
                f"{options.path}: expected intensities for views.{given[0]}, got {kind}; without "
                f"it they are used as they are"
            )
        if options.exposure is not None:
            where = Path(options.path).expanduser()
            whole = exposures(options.exposure, stack, where, options.flat, options.layout)
            self.exposure = whole[:: options.every]
        self.saturation = math.inf
        if self.kind == "intensities":
            self.saturation = options.saturation or stack.top or math.inf
            self.fields  # noqa: B018 - refuses before any view is read

    @cached_property
    def fields(self) -> Fields:
        """Dark field and contrast of the kept pixels in grey values."""
        where = Path(self.options.path).expanduser()
        layout, exposure, used = (getattr(self.options, n) for n in ("layout", "exposure", "used"))
        dark, flat = (
            self._kept(mean_field(self.stack, where, name, value, layout, exposure, used))
            for name, value in (("dark", self.options.dark), ("flat", self.options.flat))
        )
        given = (
            self.options.flat if self.options.flat is not None else self.stack.fields.get("flat")
        )
        saturation = math.inf if isinstance(given, int | float) else self.saturation
        return fields(dark, flat, str(self.options.path), self.options.dead, saturation)

    @property
    def flips(self) -> tuple[bool, bool]:
        """Whether the rows and the columns on disk are reversed."""
        return self.options.flip_rows, self.options.flip_columns != self.stack.mirrored

    @property
    def names(self) -> list[str]:
        """Names of the selected views."""
        return list(self.stack.names[:: self.options.every])

    @property
    def n_views(self) -> int:
        """Number of selected views."""
        return len(self.names)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns after cropping and binning."""
        return self.region.shape

    def cameras(self, cameras: Cameras) -> Cameras:
        """Convert the cameras of all views on disk: each n-th, cropped, binned.

        Raises:
            ValueError: another number of cameras than of views on disk, or another detector: other
                pixels, or other sizes than in the file.
        """
        if len(cameras) != self.stack.n_views:
            raise ValueError(
                f"{self.options.path}: expected one camera for each of {self.stack.n_views} views "
                f"of {self.stack.shape} pixels (rows, columns), got {len(cameras)} cameras; is a "
                f"view missing, another image among them (views.pattern=scan_*.tif chooses), or "
                f"another axis than the first that of the views (views.layout=sinogram: that of "
                f"the rows)?"
            )
        self.stack.check_rig(cameras)
        return self.region.seen_by(cameras[:: self.options.every])

    def divided_by(self, gains: Float[Tensor, " m"]) -> "MeasuredViews":
        """The views with integrals divided by the gain of each, as from a calibration."""
        other = copy(self)
        other.gains = gains if self.gains is None else gains * self.gains
        return other

    def linearised(self, coefficients: Sequence[float]) -> "MeasuredViews":
        """The views with line integrals corrected by a polynomial, `linearise`."""
        other = copy(self)
        other.options = replace(self.options, linearise=coefficients)
        return other

    def as_counts(self) -> "MeasuredViews":
        """The same stored values as counts of emission.

        Raises:
            Refused: grey values.
        """
        if self.kind == "intensities":
            raise Refused(
                f"{self.options.path}: expected counts for a projector of emission, got grey "
                f"values; views.kind=counts is for those of a gamma camera"
            )
        other = copy(self)
        other.kind = "counts"
        return other

    def read(self, first: int, last: int) -> Corrected:
        """Read the selected views `first` to `last - 1` as line integrals.

        Raises:
            IndexError, Refused: see `ProjectionStack.read`; a view without any light.
        """
        if not 0 <= first < last <= self.n_views:
            raise IndexError(f"expected views within 0 to {self.n_views}, got {first}, {last}")
        part = self._read(first, last)
        if self.options.rings is not None:
            part = replace(part, views=self._without_rings[first:last])
        polynomial = self.options.linearise
        if polynomial is not None and polynomial != "fit":
            part = replace(part, views=linearised(part.views, polynomial, part.mask))
        if self.gains is None:
            return part
        return replace(part, views=part.views / self.gains[first:last, None, None])

    def _read(self, first: int, last: int) -> Corrected:
        beside = ADJACENT if self._few else 0
        start = max(0, first - beside)
        raw = self._raw(start, min(last + beside, self.n_views))
        views = raw.new_empty(last - first, *self.shape)
        mask, odd = torch.empty_like(views, dtype=torch.bool), Counter[str]()
        step = max(1, CORRECTED_PIXELS // raw[0].numel())
        for low in range(first, last, step):
            high, begin = min(low + step, last), max(start, low - beside)
            near = raw[begin - start : high + beside - start]
            one = self._corrected(near, low, slice(low - begin, high - begin))
            part = slice(low - first, high - first)
            views[part], mask[part] = one.views, one.mask
            odd += one.odd
        return Corrected(views, mask, odd)

    def _corrected(self, raw: Float[Tensor, "n v u"], first: int, kept: slice) -> Corrected:
        """The views in `kept` of stored ones, corrected.

        Args:
            raw: stored values of consecutive views.
            first: number of the first view that is kept.
            kept: the views to correct; the others tell zingers of views with few rows.
        """
        bad = self.bad
        near = range(first - kept.start, first - kept.start + len(raw))
        values = self._light(raw, near) if self.kind == "intensities" else raw
        values = filled(values, bad) if bad.any() else values
        bright = torch.zeros_like(values[kept], dtype=torch.bool)
        if self._finds:
            light = values if self.kind == "intensities" else transmissions(values)
            few = self._few
            bright = (zingers(light.swapaxes(0, 1)).swapaxes(0, 1) if few else zingers(light))[kept]
        raw, values = raw[kept], values[kept]
        negative_marks = self.stack.excluded is not None
        unread = (raw < 0) & ~bad if negative_marks else torch.zeros_like(bright)
        lost = bright | unread
        for k in lost.flatten(1).any(dim=1).nonzero().flatten().tolist():
            values[k] = filled(values[k : k + 1], bad | lost[k])[0]
        mask = ~(bad | lost)
        if self.kind != "intensities":
            views = self.region.binned(values, counts=self.kind == "counts")
            odd = Counter(zingers=int(bright.sum()), negative=int((views < NEGATIVE).sum()))
            odd["unread"] = int(unread.sum())
            return Corrected(views, self.region.all_binned(mask), odd)
        saturated = (raw >= self.saturation) & mask
        mask = self.region.all_binned(mask & ~saturated)
        light = self.region.binned(values)
        low = light <= self.options.floor
        views = light.clamp(min=self.options.floor).log_().neg_()
        if (blank := low.flatten(1).all(dim=1)).any():
            name = self.names[first + int(blank.int().argmax())]
            raise Refused(
                f"{self.options.path}: expected light in every view, got none above the dark field "
                f"in {name} (shutter closed, or dark and flat swapped?)"
            )
        found = {"saturated": saturated, "floored": low, "zingers": bright, "unread": unread}
        found["negative"], found["dim"] = views < NEGATIVE, views > DIM
        return Corrected(views, mask, Counter({name: int(x.sum()) for name, x in found.items()}))

    def _raw(self, first: int, last: int) -> Float[Tensor, "m v u"]:
        """The kept pixels of selected views, as they are stored."""
        every = self.options.every
        if every == 1:
            return self._kept(self.stack.read(first, last))
        views = [self.stack.read(k * every, k * every + 1) for k in range(first, last)]
        return self._kept(torch.cat(views))

    def _light(self, raw: Float[Tensor, "m v u"], views: Sequence[int]) -> Float[Tensor, "m v u"]:
        """Transmissions of the grey values of selected views."""
        light = (raw - self.fields.dark).div_(self.fields.contrast)
        return light if self.exposure is None else light.div_(self.exposure[views, None, None])

    @property
    def _finds(self) -> bool:
        """Whether wrong pixels are sought in the views: not in few, in counts, nor in those that
        `mvrecon-simulate` wrote with their unit.
        """
        enough = self.options.find_bad_pixels and self.n_views >= FEWEST_VIEWS
        return enough and self.kind != "counts" and self.stack.unit is None

    @cached_property
    def bad(self) -> Bool[Tensor, "v u"]:
        """Pixels that measure wrongly, of the kept ones: by a mask, by the fields, and by the
        views.

        Warns:
            UserWarning: their number and places.

        Raises:
            Refused: no such mask, or more than half of the pixels.
        """
        where = self.options.path
        (top, bottom), (left, right) = self.region.rows, self.region.columns
        bad = torch.zeros(bottom - top, right - left, dtype=torch.bool)
        if (marked := self.stack.marked) is not None:
            bad = self._kept(marked)
        if self.options.bad_pixels is not None:
            bad = bad | self._kept(bad_pixels(self.options.bad_pixels, self.stack.shape))
        if self.kind == "intensities":
            bad = bad | ~self.fields.alive
        if self._finds and not bad.all():
            numbers = np.linspace(0, self.n_views - 1, min(self.n_views, SAMPLED_VIEWS)).round()
            sample = numbers.astype(int).tolist()
            raw = torch.cat([self._raw(k, k + 1) for k in sample])
            light = self._light(raw, sample) if self.kind == "intensities" else transmissions(raw)
            wrong = wrong_in_views(filled(light, bad)) & ~bad
            if wrong.sum() > MAX_WRONG * wrong.numel():
                warnings.warn(
                    f"{where}: {int(wrong.sum())} of {wrong.numel()} pixels differ from their "
                    f"neighbours in most views, too many to be single wrong ones; they are used as "
                    f"they are. A flat field corrects unequal pixels",
                    stacklevel=2,
                )
            else:
                bad = bad | wrong
        if 2 * int(bad.sum()) > bad.numel():
            raise Refused(
                f"{where}: expected at least half of the pixels to measure, got {int(bad.sum())} "
                f"bad ones of {bad.numel()}"
            )
        if count := int(bad.sum()):
            rows, columns = (
                range(size)[::-1] if flip else range(size)
                for size, flip in zip(self.stack.shape, self.flips, strict=True)
            )
            places = in_words(bad, rows[top:bottom], columns[left:right])
            warnings.warn(
                f"{where}: {count} of {bad.numel()} pixels are dead, hot or stuck ({places}); they "
                f"are filled from their neighbours and left out of the mask",
                stacklevel=2,
            )
        return bad

    @property
    def _few(self) -> bool:
        """Whether views have too few rows, before binning, to tell zingers by themselves."""
        return self._finds and self.region.rows[1] - self.region.rows[0] < ROWS_OF_IMAGES

    @cached_property
    def _without_rings(self) -> Float[Tensor, "m v u"]:
        """All views without rings, in memory."""
        rows, columns = self.shape
        check_memory(8 * self.n_views * rows * columns, f"Rings of {self.options.path}: all views")
        step = max(1, READ_PIXELS // math.prod(self.stack.shape))
        parts = range(0, self.n_views, step)
        views = torch.cat([self._read(k, min(k + step, self.n_views)).views for k in parts])
        assert self.options.rings is not None
        return without_rings(views, self.options.rings, self.options.ring_width)

    def chunks(self, pixels: int = READ_PIXELS) -> Iterator[Corrected]:
        """All views in order, in chunks of a number of pixels on disk.

        Warns:
            UserWarning: after the last, the number of pixels that were saturated, at the floor,
                bright or unread in single views; most line integrals are negative.
        """
        step = max(1, pixels // math.prod(self.stack.shape))
        odd = Counter[str]()
        for first in range(0, self.n_views, step):
            part = self.read(first, min(first + step, self.n_views))
            odd += part.odd
            yield part
        self.warn_of_values(odd)

    def whole(self) -> Corrected:
        """Read all views into memory.

        Warns:
            UserWarning: see `chunks`.

        Raises:
            ValueError: more than available memory; and see `read`.
        """
        rows, columns = self.shape
        check_memory(5 * self.n_views * rows * columns, f"All views of {self.options.path}")
        views = torch.empty(self.n_views, rows, columns)
        mask = torch.empty(self.n_views, rows, columns, dtype=torch.bool)
        first, odd = 0, Counter[str]()
        for part in self.chunks():
            last = first + len(part.views)
            views[first:last], mask[first:last] = part.views, part.mask
            first, odd = last, odd + part.odd
        return Corrected(views, mask, odd)

    def _kept(self, raw: Tensor) -> Tensor:
        """The region's rows and columns of pixels on disk, in the cameras' order."""
        return self.region.cropped(raw.flip([axis - 2 for axis in (0, 1) if self.flips[axis]]))

    def warn_of_values(self, odd: Counter[str]) -> None:
        """Warn of pixels that were saturated, at the floor, bright or unread in single views, if
        any, and of line integrals most of which are negative, or all of which are large.
        """
        if 2 * odd["negative"] > (pixels := self.n_views * math.prod(self.shape)):
            cause = (
                "the views are brighter than their flat field: were they taken with another "
                "exposure or beam (views.exposure), or stored on another scale?"
                if self.kind == "intensities"
                else "are they line integrals (views.kind)?"
            )
            warnings.warn(
                f"{self.options.path}: {odd['negative']} of {pixels} line integrals are below "
                f"{NEGATIVE:g}; {cause}",
                stacklevel=3,
            )
        if odd["dim"] > (1 - BRIGHT) * pixels:
            warnings.warn(
                f"{self.options.path}: the views are less than a tenth as bright as their flat "
                f"field in all pixels; does the object cover the detector? Else they were taken "
                f"with another exposure or beam, or stored on another scale, or the numbers of "
                f"views.exposure are not relative to the flat field's",
                stacklevel=3,
            )
        floor = self.options.floor
        for name, words in {
            "zingers": "are brighter than all their neighbours in one view (zingers); they are "
            "filled from these and left out of the mask",
            "unread": "are negative, which marks bad ones; they are filled from their neighbours "
            "and left out of the mask",
            "saturated": f"are saturated (grey value {self.saturation:g} or more); they are left "
            f"out of the mask",
            "floored": f"have a transmission of at most {floor:g}; they count as "
            f"{-math.log(floor):.3g}",
        }.items():
            if count := odd[name]:
                warnings.warn(
                    f"{self.options.path}: {count} pixels of {self.n_views} views {words}",
                    stacklevel=3,
                )
