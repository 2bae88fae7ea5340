"""What a calibration from the views fits: names, the numbers of each view that they stand for, and
the rig that the numbers make.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.cameras.field import isocentre
from mvrecon.geometry.cameras.misalignment import Misalignment


class Kind(NamedTuple):
    """A number that a view has.

    Args:
        field, column: of `Misalignment`; None: the logarithm of the view's gain.
        longest: change in a round at most, in pixels, degrees or as a logarithm.
    """

    field: str | None
    column: int
    longest: float


KINDS = {
    "offset_u": Kind("offset_px", 0, 3.0),
    "offset_v": Kind("offset_px", 1, 3.0),
    "slant": Kind("tilt_degrees", 0, 3.0),
    "swivel": Kind("tilt_degrees", 1, 3.0),
    "tilt": Kind("tilt_degrees", 2, 3.0),
    "gain": Kind(None, 0, 0.3),
}
#: What has a number of its own in every view, and the kinds of the numbers.
SINGLE = {"shifts": ("offset_u", "offset_v"), "gains": ("gain",)}
#: What may be fitted; what all views share has one number.
NAMES = (*(name for name in KINDS if name != "gain"), *SINGLE)


class Unknowns(NamedTuple):
    """The numbers of all views, as far as they are free: values = basis z for any z.

    Args:
        kinds: names of the numbers that a view has.
        basis: of the values that are allowed; its columns have unit length.
    """

    kinds: tuple[str, ...]
    basis: Float[Tensor, "m k n"]

    @property
    def longest(self) -> Float[Tensor, " k"]:
        """The longest change in a round, of each kind."""
        return self.basis.new_tensor([KINDS[kind].longest for kind in self.kinds])

    def without(self, kinds: Sequence[str]) -> "Unknowns":
        """The same numbers, those of some kinds zero in all views."""
        free = self.basis.new_tensor([kind not in kinds for kind in self.kinds])
        return self._replace(basis=self.basis * free[:, None])

    def misalignment(self, values: Float[Tensor, "m k"]) -> Misalignment:
        """What is wrong with each view, in pixels and degrees; differentiable."""
        still = Misalignment.none(len(values))
        fields = {name: list(getattr(still, name).unbind(dim=1)) for name in still._fields}
        for name, column in zip(self.kinds, values.unbind(dim=1), strict=True):
            if field := KINDS[name].field:
                fields[field][KINDS[name].column] = column
        return Misalignment(
            **{name: torch.stack(columns, dim=1) for name, columns in fields.items()}
        )

    def gains(self, values: Float[Tensor, "m k"]) -> Float[Tensor, " m"]:
        """The factor of each view, 1 where it is not free."""
        if "gain" not in self.kinds:
            return values.new_ones(len(values))
        return values[:, self.kinds.index("gain")].exp()


def unknowns(cameras: Cameras, free: Sequence[str]) -> Unknowns:
    """The numbers that names stand for, without those that the views cannot tell.

    Shifts leave out what a moved object would cause as well; of gains the mean logarithm is zero,
    as a factor of all views is one of the object.

    Args:
        cameras: the rig as it should be.
        free: names out of `NAMES`.

    Raises:
        ValueError: no name, an unknown one, one that is there twice or is part of another; fewer
            than two views.
    """
    _check(cameras, free)
    views = len(cameras)
    kinds = tuple(k for k in KINDS if any(k in SINGLE.get(name, (name,)) for name in free))
    blocks = []
    for name in free:
        parts = SINGLE.get(name, (name,))
        rows = torch.arange(views)[:, None] * len(kinds) + torch.tensor(
            [kinds.index(kind) for kind in parts]
        )
        columns = _columns(cameras, name)
        block = columns.new_zeros(views * len(kinds), columns.shape[1])
        block[rows.flatten()] = columns
        blocks.append(block)
    return Unknowns(kinds, torch.cat(blocks, dim=1).reshape(views, len(kinds), -1))


def without_motion(cameras: Cameras, shifts: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
    """Shifts of views in pixels, less those that a moved object would cause as well (three degrees
    of freedom, at the isocentre).
    """
    rest = _complement(motions(cameras, isocentre(cameras)).flatten(0, 1))
    return (rest @ (rest.T @ shifts.reshape(-1, 1))).reshape(-1, 2)


def _check(cameras: Cameras, free: Sequence[str]) -> None:
    for name in free:
        if name not in NAMES:
            raise ValueError(f"Unknown misalignment {name!r}{hint(name, NAMES)}")
    single = {kind for name in free for kind in SINGLE.get(name, ())}
    if not free or len(set(free)) < len(free) or single & set(free):
        raise ValueError(
            f"expected names out of {', '.join(NAMES)}, none twice, and no offset beside the "
            f"shifts that hold it; got {', '.join(free) or 'none'}"
        )
    if len(cameras) < 2:
        raise ValueError(f"expected at least two views to calibrate from, got {len(cameras)}")


def _columns(cameras: Cameras, name: str) -> Float[Tensor, "rows n"]:
    if name == "shifts":
        return _complement(motions(cameras, isocentre(cameras)).flatten(0, 1))
    same = torch.full((len(cameras), 1), len(cameras) ** -0.5, dtype=torch.float64)
    return _complement(same) if name in SINGLE else same


def _complement(columns: Float[Tensor, "rows n"]) -> Float[Tensor, "rows k"]:
    """An orthonormal basis of what is orthogonal to all columns."""
    return torch.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :]


def motions(cameras: Cameras, centre: Float[Tensor, "3"]) -> Float[Tensor, "m 2 3"]:
    """Pixels by which a point in world mm moves in each view (u, v), for a mm along x, y and z: the
    derivative of its image.
    """
    uvw = torch.linalg.inv(cameras.frame)
    if cameras.parallel:
        return uvw[:, :2]
    at = uvw @ (centre.to(cameras.source) - cameras.source)[..., None]
    u_v, w = at[:, :2], at[:, 2:]
    return (uvw[:, :2] - u_v / w * uvw[:, 2:]) / w
