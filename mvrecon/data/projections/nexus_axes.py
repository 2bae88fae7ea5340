"""The angles of views in HDF5, and what NeXus states of the axis about which a sample turns
(NXtransformations; Könnecke and others, J. Appl. Cryst. 48, 2015).

Convention: angles are those of the cameras, counter-clockwise seen from above. A `vector` says how
the sample turns instead: counter-clockwise seen from its tip, in NeXus' coordinates, of which y
runs upwards and z along the beam.
"""

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence

import h5py
import numpy as np

from mvrecon.core.files.checks import Refused, file_errors, shown
from mvrecon.core.files.keys import Key
from mvrecon.data.linked import (
    UNITS,
    Place,
    address,
    followed,
    numbers_at,
    texts_at,
    units_of,
    values_at,
)
from mvrecon.data.storage import opened
from mvrecon.geometry.cameras.formats.common import check_degrees, check_turning

#: Degrees by the units of angles.
DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1)),
}
#: Attributes by which files state units of angles, the last one of CIL.
ANGLE_UNITS = (*UNITS, "angle_unit")
#: Attributes of a transformation besides its units.
ATTRIBUTES = ("transformation_type", "vector", "offset", "offset_units", "depends_on")
#: Of these, and of a detector's transformations.
KEYS = (
    Key("transformation_type", "refused", "of the angles", ("rotation",)),
    Key("vector", "applied", "of the sample: (0, 1, 0) turns cameras the other way; upright alone"),
    Key("rotation_angle@offset", "refused", "the axis is found by calibrate=[offset_u]", (0,)),
    Key("depends_on", "compared", "other rotations are refused, translations warned of"),
    Key("transformations", "compared", "of the detector: views.flip_columns, flip_rows; warned of"),
)
#: Types of transformations by the names that nxtomo gives them.
KINDS = {f"{kind[0]}{axis}": kind for kind in ("rotation", "translation") for axis in "xyz"}
#: Sine of the angle by which an upright axis may lean, and most transformations of a chain.
MAX_LEAN, MAX_CHAIN = 2e-3, 16


def degrees_of(angles: Place, kept: np.ndarray) -> list[float]:
    """The angles of the cameras of views in degrees.

    Args:
        angles: place of the angles of all frames, or of the views.
        kept: whether a frame is a view.

    Warns:
        UserWarning: angles of a unit that look like another.

    Raises:
        Refused: another number of angles, angles that are not finite, all equal, of unknown units,
            or that look like radians; see `_sense`.
    """
    values = values_at(angles, (*ANGLE_UNITS, *ATTRIBUTES))
    if values.size not in (len(kept), kept.sum()) or values.size != max(values.shape):
        raise Refused(
            f"{angles}: expected an angle for each of {len(kept)} frames"
            f"{'' if kept.all() else f', or of {kept.sum()} views'}, got {values.shape}"
        )
    degrees = values.ravel().astype(float)
    degrees = degrees[kept] if len(degrees) == len(kept) else degrees
    if not np.isfinite(degrees).all():
        raise Refused(f"{angles}: expected finite angles of the views, got {shown(degrees)}")
    unit = units_of([angles], ANGLE_UNITS)
    factor = DEGREES.get(unit.strip().lower()) if unit else 1.0
    if factor is None:
        raise Refused(f"{angles}: expected units of {', '.join(DEGREES)}, got {shown(unit)}")
    degrees *= factor * _sense(angles)
    with file_errors(angles.path, f"{angles.name} is no turn", "give views.angles"):
        check_turning(degrees.tolist())
        if not unit:
            check_degrees(degrees.tolist(), False, "angles without units")
    if unit:
        try:
            check_degrees(degrees.tolist(), False, "angles")
        except ValueError as error:
            warnings.warn(f"{angles}: {error}", stacklevel=2)
    return degrees.tolist()


def _sense(angles: Place) -> float:
    """The sense in which cameras turn, 1 or -1, by the attributes of a sample's angles; 1 without a
    vector.

    Raises:
        Refused: no rotation, about another axis than the vertical one, or one with an offset.
    """
    kind = texts_at([angles], "transformation_type").get(angles, "rotation")
    if kind.strip().lower() != "rotation":
        raise Refused(f"{angles}: expected the transformation_type rotation, got {shown(kind)}")
    offset = numbers_at(angles, "offset")
    if offset is not None and offset.any():
        raise Refused(
            f"{angles}: expected the offset 0 of the axis, got {shown(offset.tolist())}; remove "
            f"it, and say calibrate=[offset_u]"
        )
    vector = numbers_at(angles, "vector")
    if vector is None:
        return 1.0
    lean = math.hypot(*vector[::2]) / max(float(np.linalg.norm(vector)), 1e-300)
    if vector.shape != (3,) or not vector.any() or not lean <= MAX_LEAN:
        raise Refused(
            f"{angles}: expected the vector of a vertical axis, (0, 1, 0) or (0, -1, 0), as y of "
            f"NeXus runs upwards, got {shown(vector.tolist())}; write the one that is meant"
        )
    return float(-np.sign(vector[1]))


def translations_below(angles: Place) -> Iterator[Place]:
    """The translations on which the angles of a sample depend, or the sample itself, by their
    chains of `depends_on`.

    Args:
        angles: place of the angles of all frames, or of the views.

    Warns:
        UserWarning: a chain leads to nothing in the file.

    Raises:
        Refused: another rotation, or a chain that does not end.
    """
    own = address(angles)
    sample = Place(angles.path, angles.name.rpartition("/")[0] or "/")
    stages = [*_chain(angles, texts_at([angles], "depends_on").get(angles, ".")), *_stages(sample)]
    for place in dict.fromkeys(stage for stage in stages if address(stage) != own):
        kind = texts_at([place], "transformation_type").get(place, "translation")
        if kind.strip().lower() != "rotation":
            yield place
        elif (turned := values_at(place, (*UNITS, *ATTRIBUTES))).any():
            raise Refused(
                f"{angles}: expected an axis that no other rotation turns, got {place} of up to "
                f"{np.abs(turned).max():g}"
            )


def _stages(group: Place) -> Iterator[Place]:
    """The transformations on which a detector or a sample depends, by its own `depends_on`."""
    if (start := followed(group.path, f"{group.name}/depends_on")) is not None:
        yield from _chain(start, texts_at([start], "").get(start, "."))


def _chain(place: Place, name: str) -> Iterator[Place]:
    """The transformations on which a place depends, of which the first has this name.

    Warns:
        UserWarning: the chain leads to nothing in the file.

    Raises:
        Refused: it does not end.
    """
    start = place
    for _ in range(MAX_CHAIN):
        if (name := name.strip()) in ("", "."):
            return
        own = place.name.rpartition("/")[0]
        below = followed(place.path, name if name.startswith("/") else f"{own}/{name}")
        if below is None:
            warnings.warn(f"{place}: depends on {shown(name)}, which is not there", stacklevel=2)
            return
        yield below
        place, name = below, texts_at([below], "depends_on").get(below, ".")
    raise Refused(f"{start}: expected at most {MAX_CHAIN} transformations by depends_on, got more")


def transformations_in(group: Place) -> list[Place]:
    """What the group `transformations` of a detector or a sample contains."""
    if (chain := followed(group.path, f"{group.name}/transformations")) is None:
        return []
    with opened(chain.path) as file:
        names = list(found) if isinstance(found := file[chain.name], h5py.Group) else []
    places = [followed(chain.path, f"{chain.name}/{name}") for name in names]
    return [place for place in places if place is not None]


def translations(stages: Iterable[Place]) -> list[Place]:
    """The translations among transformations, each once."""
    return [stage for stage in dict.fromkeys(stages) if _kind(stage) == "translation"]


def _kind(stage: Place) -> str:
    """The type of a transformation, as it states it or by its name; else empty."""
    stated = texts_at([stage], "transformation_type").get(stage, "").strip().lower()
    return stated or KINDS.get(stage.name.rpartition("/")[2], "")


def warn_of_turned(groups: Sequence[Place]) -> list[Place]:
    """Warn of a detector that its transformations turn, as those of mirrored frames do: those in
    its group `transformations`, and of the chain of its `depends_on`; return its translations.

    Args:
        groups: groups in which the frames are, such as that of the detector.
    """
    stages = [stage for group in groups for stage in (*transformations_in(group), *_stages(group))]
    for place in dict.fromkeys(stages):
        if _kind(place) == "rotation" and values_at(place, (*UNITS, *ATTRIBUTES)).any():
            warnings.warn(
                f"{place}: the detector is turned; without views.flip_columns=true or "
                f"views.flip_rows=true the volume may be mirrored",
                stacklevel=2,
            )
    return translations(stages)
