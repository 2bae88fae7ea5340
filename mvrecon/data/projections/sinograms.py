"""Views in sinograms: images of one slice each, with the angles as rows."""

import math
from functools import cached_property

import numpy as np

from mvrecon.core.files.checks import Refused
from mvrecon.core.machine import check_memory
from mvrecon.data.projections.stack import READ_PIXELS, ProjectionStack

#: Attributes of a stack that hold for all views together.
OF_ALL = (
    *("kind", "unit", "dose", "own_unit", "duration_s", "total_s", "began", "window_kev"),
    *("attenuated", "detector", "rig", "mirrored", "scan", "unknown", "units"),
)


class Sinograms(ProjectionStack):
    """Views [m v u] whose row v is that of the slice v, from sinograms [v m u].

    All are held in memory as they are stored, since each view is in all of them.

    Args:
        slices: a sinogram of each slice, from the uppermost one down.
    """

    def __init__(self, slices: ProjectionStack):
        rows, columns = slices.shape
        names = [f"row {k}" for k in range(rows)]
        super().__init__(slices.path, names, (slices.n_views, columns), slices.dtype)
        self._slices = slices
        self._top = slices.top
        self.fields = {
            name: as_rows(field, self.shape) if isinstance(field, ProjectionStack) else field
            for name, field in slices.fields.items()
        }
        for name in OF_ALL:
            setattr(self, name, getattr(slices, name))
        alike = {name: {*texts} for name, texts in slices.stated.items()}
        self.stated = {name: [*text] * rows for name, text in alike.items() if len(text) == 1}
        self.excluded = None if slices.excluded is None else 0

    @property
    def top(self) -> float | None:
        return self._top

    @cached_property
    def _values(self) -> np.ndarray:
        """All views, as they are stored."""
        shape = (self.n_views, *self.shape)
        check_memory(self.dtype.itemsize * math.prod(shape), f"All sinograms of {self.path}")
        values = np.empty(shape, self.dtype)
        step = max(1, READ_PIXELS // (self.n_views * self.shape[1]))
        for k in range(0, self.shape[0], step):
            block = self._slices._block(k, min(k + step, self.shape[0]))
            if block.shape[1:] != (self.n_views, self.shape[1]):
                raise Refused(f"{self.path}: expected sinograms of one size, got others")
            values[:, k : k + step] = block.swapaxes(0, 1)
        return values

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._values[first:last]


def as_rows(field: ProjectionStack, shape: tuple[int, int]) -> ProjectionStack:
    """Images of a flat or dark field: as they are if they have a view's shape, else sinograms.

    Raises:
        Refused: several images that may be either.
    """
    if field.shape == shape and field.n_views == shape[0] > 1:
        raise Refused(
            f"{field.path}: expected fields of which the axis of rows is known, got {shape[0]} "
            f"images of {shape[0]} rows beside sinograms; give their mean, one image"
        )
    return field if field.shape == shape else Sinograms(field)


def looks_like_sinogram(stack: ProjectionStack) -> bool:
    """Whether a stack is one image of several rows, which may be views or angles."""
    return stack.n_views == 1 and stack.shape[0] > 1
