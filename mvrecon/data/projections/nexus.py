"""Views in HDF5 as beamlines write it: NXtomo of NeXus (Könnecke and others, J. Appl. Cryst. 48,
2015), Data Exchange (De Carlo and others, J. Synchrotron Rad. 21, 2014), or any data set of frames.
"""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from mvrecon.core.files.checks import Refused, check_file, file_errors, millimetres, shown
from mvrecon.core.files.keys import IMAGE_EFFECTS, unknown_names
from mvrecon.data.linked import (
    UNITS,
    VIEW_AXES,
    MissingFile,
    Place,
    address,
    check_around,
    check_order,
    followed,
    groups,
    groups_above,
    groups_of,
    listing,
    members,
    texts_at,
    units_at,
    unknown_around,
    unknown_attributes,
    values_at,
)
from mvrecon.data.projections import exposures, nexus_axes
from mvrecon.data.projections.arrays import Hdf5Views
from mvrecon.data.projections.frames import Frames, FrameViews
from mvrecon.data.projections.nexus_detector import (
    ALIGNMENT,
    BEAM,
    DARK,
    DETECTOR_BEAM,
    FLAT,
    INVALID,
    VIEW,
    first,
    kinds_in,
    limits_in,
    limits_of,
    of_frames,
    there,
)
from mvrecon.data.projections.nexus_keys import KEYS
from mvrecon.data.projections.stack import ProjectionStack
from mvrecon.data.storage import fields_in, held, opened

EXPECTED = (
    "frames [m v u] beside an image_key (NXtomo), /exchange/data (Data Exchange), views of "
    "mvrecon-simulate, or other frames by views.dataset=<name> (of fields, by <file>:/<name>)"
)
FRAMES = "frames [m v u], or [v m u] of views.layout=sinogram"
#: Names of a data set, or of one in another file.
IN_FILE = re.compile(r"(?P<path>.+\.\w+):(?P<name>/.*)")
#: Words of fields beside the frames by the values of these that change nothing; of others it is 0.
FIELD_EFFECTS = {**IMAGE_EFFECTS, "binning": 1}
#: Keys that do not count, wherever they stand, or that are read wherever they do.
IDLE = [key for key in KEYS if key.use == "ignored" or key in nexus_axes.KEYS]
#: Sources whose beams are parallel; those of NeXus's other kinds, such as tubes, are not.
PARALLEL = re.compile("synchrotron|neutron|muon|free.electron", re.IGNORECASE)
#: Pixels by which a sample may move between views.
MAX_MOVE_PX = 0.1


def hdf5_views(
    path: Path,
    dataset: str | None = None,
    angles: str | Path | None = None,
    image_key: str | Path | None = None,
    layout: str | None = None,
    field: str | None = None,
) -> ProjectionStack:
    """Open the views of an HDF5 file: those of mvrecon-simulate, of NXtomo or Data Exchange, or a
    data set by its name.

    Links are followed to other files in the file's folder, and below.

    Args:
        path: path of the file.
        dataset: name of the frames [m v u]; None: those beside an image_key, or /exchange/data.
        angles: name of the angles, of all frames or of the views, in this file or as
            "<file>:<name>" in another; None: rotation_angle of NXtomo, theta of Data Exchange, if
            there.
        image_key: name of the key of each frame, in this or another file; None: the one beside the
            frames, if there.
        layout: "sinogram": frames are images of slices, with the angles as rows.
        field: "flat" or "dark": open these frames, or all frames if the file has no such ones; they
            need no angles.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not HDF5, no or several frames, keys or angles of another number than frames,
            units of neither angles nor lengths, links to files elsewhere, damage.
    """
    check_file(path, EXPECTED)
    if not h5py.is_hdf5(path):
        raise Refused(f"{path}: not an HDF5 file, or cut short; expected {EXPECTED}")
    with held(), file_errors(path, "cannot be read as HDF5"):
        if dataset is None and (place := followed(path, "/views")) is not None:
            if angles is image_key is None and texts_at([place], "unit"):
                return Hdf5Views(path)
            dataset = "/views"  # of another program
        places = _Layout.of(path, dataset, layout == "sinogram")
        if angles is not None:
            places = places._replace(angles=named(path, angles))
        if image_key is not None:
            places = places._replace(key=named(path, image_key))
        if field is not None:
            places = places.of_field(path.parent.resolve())
        return places.opened(path, field)


def named(path: Path, name: str | Path) -> Place:
    """The data set of a name in a file, or else of "<file>:<name>".

    Raises:
        Refused: there is none.
    """
    if place := followed(path, str(name)) or in_another(name):
        return place
    other, own = Path(name).expanduser(), listing(path)
    file = f"nor is there a file {other}; the first contains {own}"
    if other.is_file():
        file = f"and {other} is a file: name its data set by {other}:/<name>, or one of {own}"
    raise Refused(f"{path}: has no data set {name}, {file}")


def in_another(name: str | Path) -> Place | None:
    """The data set of "<file>:<name>"; None for other texts.

    Raises:
        FileNotFoundError: the file does not exist.
        Refused: it has no such data set.
    """
    if (inside := IN_FILE.fullmatch(str(name))) is None:
        return None
    file = Path(inside["path"]).expanduser()
    check_file(file, "an HDF5 file")
    if (place := followed(file, inside["name"])) is None:
        raise Refused(f"{file}: has no {inside['name']}; it contains {listing(file)}")
    return place


class _Layout(NamedTuple):
    """The data sets of a scan in an HDF5 file."""

    frames: Place
    key: Place | None = None
    angles: Place | None = None
    fields: Sequence[tuple[str, Place]] = ()
    pixel: Sequence[tuple[Place, Place]] = ()
    beam: str | None = "parallel"
    sinogram: bool = False
    exposures: Sequence[tuple[str, Place]] = ()
    flats: Sequence[tuple[str, Place]] = ()  # exposures of flat fields beside the frames
    moves: Sequence[Place] = ()
    names: Sequence[Place] = ()  # of the frames: in these groups are the keys beside them
    others: Sequence[str] = ()  # monitors and beams of other names than those that are read
    used: Sequence[Place] = ()  # what the layout found, beside the frames too

    @property
    def axes(self) -> tuple[str, str, str]:
        """Names of the frames' axes."""
        m, v, u = VIEW_AXES
        return (v, m, u) if self.sinogram else (m, v, u)

    @classmethod
    def of(cls, path: Path, dataset: str | None, sinogram: bool) -> "_Layout":
        """The layout of a file, by the name of the frames if given."""
        wanted = None if dataset is None else named(path, dataset)
        names = {} if wanted is None else {address(wanted): [wanted]}
        with opened(path) as file:
            keyed = {g.name: "image_key" in g.keys() for g in groups(file) if "data" in g.keys()}  # noqa: SIM118
        exchange = "/exchange/data"
        known, lost = set(), []
        for group in sorted(keyed, key=lambda name: -name.count("/")):  # detector first
            own = f"{group.rstrip('/')}/data"
            try:
                place = followed(path, own)
            except MissingFile as error:
                lost += [error] if keyed[group] or own == exchange else []
                continue
            if place is not None:
                place = place._replace(links=(Place(path, own), *place.links))
                names.setdefault(address(place), []).append(place)
                known |= {address(place)} if keyed[group] or own == exchange else set()
        found = {*names} & known if wanted is None else {address(wanted)}
        if len(found) != 1:
            if lost and not found:
                raise lost[0]
            places = ", ".join(str(names[one][0]) for one in names if one in found)
            got = f"frames in {places}; choose by views.dataset=<name>"
            if not found:
                got = f"none; it contains {listing(path)}"
            raise Refused(f"{path}: expected {EXPECTED}, got {got}")
        one = found.pop()
        layout = cls._tomo(names[one])
        if any(place.links and place.links[0].name == exchange for place in names[one]):
            layout = layout._exchange(path, sinogram)
        elif one not in known:
            layout = layout._replace(angles=None)
        if sinogram:  # what is stated of frames is not of rows
            layout = layout._replace(sinogram=True, exposures=())
        other = layout.key is not None and _size(layout.key) != _count(layout.frames)
        if dataset is not None and other:  # such as of the frames that these were made of
            layout = layout._replace(key=None)
        layout = layout._replace(used=layout._found())
        for place in names[one]:  # NXdata may scale what it links to, or state its axes
            check_around(place)
        for group, own in groups_of(names[one]).items():
            if texts_at([group], "signal").get(group, own) == own:
                check_order(group, layout.axes, FRAMES)
        return layout

    @classmethod
    def _tomo(cls, names: Sequence[Place]) -> "_Layout":
        """The layout of NXtomo, by the names of the frames."""
        beside = [*groups_of(names)]
        exchange = [Place(path, "/measurement") for path in dict.fromkeys(g.path for g in beside)]
        above = [*(outer for group in beside for outer in groups_above(group)), *exchange]
        detectors = [*beside, *(g._replace(name=f"{g.name}/instrument/detector") for g in exchange)]
        frames, instrument = names[0], first(above, "instrument", find=there)
        kinds = {} if instrument is None else kinds_in([*groups_above(instrument)][:2])
        sources = [group for group, kind in kinds.items() if kind == "NXsource"]
        source = first(above, "instrument/source/type", "source/type") or first(sources, "type")
        kind = None if source is None else texts_at([source], "").get(source)
        parallel = kind is None or PARALLEL.search(kind)
        for axis, option in (("x", "columns"), ("y", "rows")):
            flipped = first(beside, f"{axis}_flipped", find=there)
            if flipped is not None and values_at(flipped).any():
                warnings.warn(
                    f"{flipped}: the {option} of the frames are mirrored; without "
                    f"views.flip_{option}=true so is the volume",
                    stacklevel=2,
                )
        moves = [
            *nexus_axes.warn_of_turned(beside),
            *nexus_axes.translations(
                stage
                for group in above
                for stage in nexus_axes.transformations_in(
                    group._replace(name=f"{group.name}/sample")
                )
            ),
        ]
        entries = [group for group in above if group.name.rpartition("/")[2] != "instrument"]
        shares = [f"instrument/{name}/{exposures.ATTENUATOR}" for name in members(instrument)]
        sizes = [
            [first(above, f"sample/{axis}_pixel_size"), first(beside, f"{axis}_pixel_size")]
            for axis in "yx"
        ]
        pairs = [(y, x) for y, x in zip(*sizes, strict=True) if y is not None and x is not None]
        return cls(
            frames,
            first(beside, "image_key_control", "image_key"),
            first(above, "sample/rotation_angle", "data/rotation_angle", "rotation_angle"),
            (),
            pairs,
            "parallel" if parallel else None,
            exposures=[
                (name, place)
                for where, those in (
                    (detectors, (*exposures.DETECTOR, *DETECTOR_BEAM)),
                    (entries, (*exposures.MONITORS, *shares, *BEAM)),
                )
                for name in those
                if (place := first(where, name, find=there)) is not None
            ],
            moves=[
                place
                for axis in "xyz"
                for where, name in ((above, "sample/"), (beside, ""))
                if (place := first(where, f"{name}{axis}_translation")) is not None
            ]
            + moves,
            names=names,
            others=[
                name
                for group, kind in kinds.items()
                if kind in ("NXmonitor", "NXbeam")
                and (name := group.name.rpartition("/")[2]) not in ("control", "beam")
            ],
        )

    def _exchange(self, path: Path, sinogram: bool) -> "_Layout":
        """The layout of Data Exchange, which adds to that by the names of the frames."""
        order = "y:theta:x" if sinogram else "theta:y:x"
        axes = texts_at([self.frames], "axes").get(self.frames)
        if axes is not None and axes.replace(" ", "") != order:
            raise Refused(
                f"{self.frames}: expected the axes {order}, got {shown(axes)}; "
                f"views.layout=sinogram is for y:theta:x"
            )
        places = {
            name: followed(path, f"/exchange/{name}")
            for name in ("data_white", "data_dark", "theta")
        }
        kept = [("flat", places["data_white"]), ("dark", places["data_dark"])]
        flats = {name: place for name, place in self.exposures if _size(place) == 1}
        flats |= {exposures.EXCHANGE: time} if (time := _flat_time(path)) else {}
        return self._replace(
            angles=places["theta"] or self.angles,
            fields=[(n, p) for n, p in kept if p is not None],
            flats=[*flats.items()],
        )

    def opened(self, scan: Path, field: str | None = None) -> ProjectionStack:
        """The views, with fields and rig, of a scan's file; or its frames of a field, if any."""
        folder = scan.parent.resolve()
        frames = Frames(self.frames, folder)
        check_order(self.frames, self.axes, FRAMES)
        keys = self._keys(frames.shape[0])
        lengths = [place for pair in self.pixel for place in pair]
        monitors = [place for _, place in (*self.exposures, *self.flats)]
        units = units_at([*lengths, *monitors])
        stated = {n: of_frames(n, p, keys, units.get(p, "")) for n, p in self.exposures}
        angles = [] if self.angles is None else [self.angles]
        below = [stage for place in angles for stage in nexus_axes.translations_below(place)]
        near = {} if self.sinogram or field is not None else limits_in([*groups_of(self.names)])
        marks = [place for place in (self.key, near.get("pixel_mask")) if place is not None]
        unknown = [
            *self._unknown_fields(below, frames.parts, field),
            *self.others,
            *(name for place in angles for name in unknown_around(place)),
            *(name for place in marks for name in unknown_attributes(place)),
        ]
        fields: dict[str, ProjectionStack] = {
            name: FrameViews(frames, np.flatnonzero(keys == key), stated=stated, unknown=unknown)
            for name, key in (("flat", FLAT), ("dark", DARK))
            if (keys == key).any()
        }
        for name, place in self.fields:
            others = Frames(place, folder)
            if not self.sinogram:  # else in either order, by its size
                check_order(place, VIEW_AXES, FRAMES)
            kind = np.full(others.shape[0], FLAT)
            of_flats = {
                n: of_frames(n, p, kind, units.get(p, "")) for n, p in self.flats if name == "flat"
            }
            beside = self._replace(names=[place], angles=None)._unknown_fields(
                (), others.parts, name
            )
            fields[name] = FrameViews(others, np.arange(len(kind)), stated=of_flats, unknown=beside)
        if field in fields:
            return fields[field]
        if field is None and texts_at([self.frames], "MATLAB_class"):
            warnings.warn(
                f"{self.frames}: MATLAB reverses the order of axes: {FRAMES} are its arrays (u, v, "
                f"m), or (u, m, v); permute those of another order",
                stacklevel=2,
            )
        views = np.flatnonzero(keys == VIEW)
        rig: dict[str, Any] = {"name": self.beam if self.angles else None, "detector": {}}
        if angles:
            turns = np.zeros(frames.shape[1], int) if self.sinogram else keys
            rig["angles"] = nexus_axes.degrees_of(angles[0], turns == VIEW)
        if (pixel := self._pixel_mm(units)) is not None:
            rig["detector"]["pixel_mm"] = pixel
        self._warn_of_moves(keys, pixel, below)
        limits = limits_of(near, frames, keys)
        return FrameViews(frames, views, fields, rig, scan, stated, *limits, unknown)

    def of_field(self, folder: Path) -> "_Layout":
        """The layout of frames that may be a field: without angles and pixels, and without
        exposures and a key of another number of frames, such as views.
        """
        count = Frames(self.frames, folder).shape[0]
        return self._replace(
            key=self.key if self.key and _size(self.key) == count else None,
            angles=None,
            pixel=(),
            exposures=[one for one in self.exposures if _size(one[1]) in (1, count)],
            moves=(),
        )

    def _found(self) -> list[Place]:
        """The data sets that the layout uses, or that do not count beside those."""
        beside = [*groups_of(self.names)]
        keys = [first(beside, name) for name in ("image_key_control", "image_key")]
        flips = [first(beside, f"{axis}_flipped", find=there) for axis in "xy"]
        found = [
            *(place for place in (*(keys if self.key else ()), *flips) if place is not None),
            *(place for pair in self.pixel for place in pair),
            *(place for _, place in (*self.fields, *self.exposures, *self.flats)),
            *([] if self.sinogram else limits_in(beside).values()),
        ]
        return [*self.moves, *found, *([] if self.angles is None else [self.angles])]

    def _unknown_fields(
        self, below: Sequence[Place], parts: Sequence[Place], field: str | None
    ) -> list[str]:
        """Data sets beside the frames, their parts and the angles that no key knows, but those on
        which the angles depend; and of views those beside the frames, and beside parts if they have
        no such name, that a key knows and that are not used.
        """
        angles = [] if self.angles is None else [self.angles]
        own, others = groups_of(self.names), groups_of(parts)
        names = own | others | groups_of(angles)
        used = {*map(address, (*self.names, *self.used, *angles))}
        restated = {place.name.rpartition("/")[2] for place in (*self.used, *angles, *below)}
        found: list[str] = []
        for group in names:
            with opened(group.path) as file:
                fields = fields_in(file[group.name], FIELD_EFFECTS)
            unknown = unknown_names(fields, KEYS if field or group not in {*own, *others} else IDLE)
            for name in unknown:
                place = there(group.path, f"{group.name}/{name}")
                known = name in restated if group not in own else False
                if not known and (place is None or address(place) not in used):
                    found.append(name)
        return [name for name in dict.fromkeys(found) if name not in names.values()]

    def _keys(self, count: int) -> np.ndarray:
        """The image_key of each of so many frames; all are views without one."""
        if self.key is None:
            return np.zeros(count, int)
        if self.sinogram:
            raise Refused(f"{self.key}: expected no keys of sinograms, got some")
        stored = values_at(self.key)
        if (keys := stored.ravel()).shape != (count,) or max(stored.shape, default=1) < count:
            raise Refused(
                f"{self.key}: expected a key for each of {count} frames, got {stored.shape}"
            )
        if unknown := sorted({*keys.tolist()} - {VIEW, FLAT, DARK, INVALID, ALIGNMENT}):
            raise Refused(
                f"{self.key}: expected keys 0 (views), 1 (flat), 2 (dark), 3 (invalid) or -1 "
                f"(alignment), got {shown(unknown)}"
            )
        return keys

    def _warn_of_moves(
        self, keys: np.ndarray, pixel: tuple[float, float] | None, below: Sequence[Place]
    ) -> None:
        """Warn of translations of the sample or the detector between views, by more than a part of
        a pixel.
        """
        for place in dict.fromkeys((*self.moves, *below)):
            moved = values_at(place, (*UNITS, *nexus_axes.ATTRIBUTES)).ravel()
            far = np.ptp(moved[keys == VIEW] if len(moved) == len(keys) else moved)
            unit = units_at([place]).get(place)
            if far and not (
                pixel and unit and far * millimetres(place, unit) < MAX_MOVE_PX * min(pixel)
            ):
                warnings.warn(
                    f"{place}: the sample moved by {far:g}{f' {unit}' if unit else ''} between "
                    f"views, in relation to the detector, which the rig does not follow; "
                    f"calibrate=[shifts] fits shifts",
                    stacklevel=3,
                )

    def _pixel_mm(self, units: dict[Place, str]) -> tuple[float, float] | None:
        """Pixel size (v, u) in mm; None if the file has none with units."""
        for pair in self.pixel:
            sizes = []
            for place in pair:
                values = np.unique(values_at(place, UNITS))
                if not (unit := units.get(place)):
                    warnings.warn(f"{place}: has no units, and is not used", stacklevel=2)
                elif len(values) == 1 and values[0] > 0:
                    sizes.append(float(values[0]) * millimetres(place, unit))
                else:
                    raise Refused(f"{place}: expected one positive size, got {shown(values)}")
            if len(sizes) == 2:
                return sizes[0], sizes[1]
        return None


def _size(place: Place) -> int:
    """The number of values of a data set; 0 of a group."""
    with opened(place.path) as file:
        return getattr(file[place.name], "size", 0)


def _count(frames: Place) -> int:
    """The number of frames [m v u], or of the one [v u], of a data set; 0 of others."""
    with opened(frames.path) as file:
        shape = getattr(file[frames.name], "shape", None) or ()
    return shape[0] if len(shape) == 3 else 1


def _flat_time(path: Path) -> Place | None:
    """The exposure time of Data Exchange's flat fields, where it is not that of the views."""
    above = "/process/acquisition/flat_fields"
    if (differs := there(path, f"{above}/different_flat_exposure")) is not None:
        text = texts_at([differs], "")[differs].strip().lower()  # or a type of numbers
        number = re.match("u?int|bool", text) is not None
        if text in ("same", "no") or (number and not values_at(differs).any()):
            return None
    return there(path, f"{above}/flat_exposure_time")
