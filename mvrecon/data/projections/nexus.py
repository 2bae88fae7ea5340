"""Views in HDF5 as beamlines write it: NXtomo of NeXus (Könnecke and others, J. Appl. Cryst. 48,
2015), Data Exchange (De Carlo and others, J. Synchrotron Rad. 21, 2014), or any data set of frames.
"""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from mvrecon.core.files.checks import Refused, check_file, file_errors, millimetres, shown
from mvrecon.core.files.keys import Key
from mvrecon.data.linked import (
    MissingFile,
    Place,
    address,
    beside,
    followed,
    groups,
    listing,
    texts_at,
    values_at,
)
from mvrecon.data.projections.stack import VIEWS, Hdf5Views, ProjectionStack
from mvrecon.data.storage import check_attributes, check_chunks, dataset_in, opened
from mvrecon.geometry.cameras.formats.common import check_degrees, check_turning

EXPECTED = (
    "frames [m v u] beside an image_key (NXtomo), /exchange/data (Data Exchange), views of "
    "mvrecon-simulate, or views.dataset=<name> of other frames"
)
#: Names of a data set, or of one in another file.
IN_FILE = re.compile(r"(?P<path>.+\.\w+):(?P<name>/.*)")
#: Frames of views, flat and dark fields by their image_key; others are left out.
VIEW, FLAT, DARK, INVALID, ALIGNMENT = 0, 1, 2, 3, -1
#: `H5S_SEL_ALL` of HDF5: a whole data set.
SELECTS_ALL = 3
#: Degrees by the units of angles.
DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1)),
}
#: Data sets of NXtomo and Data Exchange.
KEYS = (
    Key("image_key", "applied", "0 views, 1 flat fields, 2 dark fields; 3, invalid, left out"),
    Key("image_key_control", "applied", "in place of image_key; -1, alignment, left out"),
    Key("data, data_white, data_dark", "applied", "frames, flat and dark fields"),
    Key("rotation_angle, theta", "applied", "of all frames or of the views; in its units"),
    Key("x_pixel_size, y_pixel_size", "applied", "of the sample, else of the detector, in units"),
    Key(
        "units", "refused", "of angles and lengths", ("degrees", "radians", "m", "mm", "um", "...")
    ),
    Key(
        "axes",
        "refused",
        "of Data Exchange's data; the last one for sinograms",
        ("theta:y:x", "y:theta:x"),
    ),
    Key("scale_factor, add_offset, _FillValue", "refused", "apply it", (1, 0, "nan")),
    Key("source/type", "applied", "beams of tubes are not parallel: the camera is asked for"),
    Key(
        "count_time, control/data",
        "compared",
        "exposures and the beam's monitor, of views with fields; warned of, applied by "
        "views.exposure",
    ),
    Key("x_flipped, y_flipped", "compared", "views.flip_columns, flip_rows; warned of"),
    Key("x_translation, y_translation, z_translation", "compared", "of all views; warned of"),
    Key("pixel_mask, saturation_value", "compared", "views.bad_pixels, saturation; warned of"),
    Key(
        "scaling_factor, offset, data_scaling_factor, data_offset",
        "refused",
        "fields beside the data set that they scale; apply them",
        (1, 0),
    ),
    Key(
        "field_of_view, estimated_cor_from_motor, x_rotation_axis_pixel_position",
        "ignored",
        "calibrate=[offset_u] finds the axis",
    ),
    Key("theta_white, theta_dark, distance, energy", "ignored", "not needed"),
)
#: Sources whose beams are parallel; those of NeXus's other kinds, such as tubes, are not.
PARALLEL = re.compile("synchrotron|neutron|muon|free.electron", re.IGNORECASE)
#: Difference of exposures, or of the beam, that is warned of.
MAX_CHANGE = 0.01
#: Pixels by which a sample may move between views.
MAX_MOVE_PX = 0.1
#: Attributes of a motion in NeXus that say where its axis is.
TRANSFORMATION = ("offset", "vector", "offset_units")


class Segment(NamedTuple):
    """Consecutive frames of a data set."""

    place: Place
    first: int
    count: int


class Frames:
    """Frames [n v u] of one data set, or of those that a virtual one consists of.

    Args:
        place: of the data set; one image is one frame.
        folder: other files must be in it, or below.

    Raises:
        Refused: not frames, or virtual frames whose parts are missing or are no whole frames.
    """

    def __init__(self, place: Place, folder: Path):
        self.place, self._sound = place, set()
        with opened(place.path, EXPECTED) as file:
            stored: Any = file[place.name]
            if not isinstance(stored, h5py.Dataset):
                raise Refused(f"{place}: expected a data set of frames, got a group")
            if not (stored.ndim in (2, 3) and stored.dtype.kind in "iuf"):
                got = f"{stored.dtype} {stored.shape}"
                raise Refused(f"{place}: expected numbers [m v u] of frames, got {got}")
            self.shape = (1,) * (3 - stored.ndim) + stored.shape
            self.dtype = stored.dtype
            check_attributes(place.path, stored, ("units",))
            if not stored.is_virtual:
                self.parts = [Segment(place, 0, self.shape[0])]
            else:
                self.parts = [self._part(source, folder) for source in stored.virtual_sources()]
        ends = np.cumsum([0, *(part.count for part in self.parts)])
        if ends[-1] != self.shape[0]:
            raise Refused(
                f"{place}: expected parts with all {self.shape[0]} frames, got {ends[-1]}"
            )
        self._ends = ends.tolist()

    def _part(self, source: Any, folder: Path) -> Segment:
        """A part of a virtual data set, which follows the part before it."""
        path = self.place.path
        if source.file_name != ".":
            path = beside(path, source.file_name, self.place.name, folder)
        found, rows = followed(path, source.dset_name, EXPECTED, folder), self.shape[1:]
        if found is not None:
            with opened(found.path, EXPECTED) as file:
                shape = dataset_in(found.path, file, found.name, EXPECTED).shape
            start, end = source.vspace.get_select_bounds()
            first, count = 0, end[0] - start[0] + 1
            pixels = [source.vspace.get_select_npoints()]
            if source.src_space.get_select_type() != SELECTS_ALL:
                first = source.src_space.get_select_bounds()[0][0]
                pixels.append(source.src_space.get_select_npoints())
            elif shape[0] != count:
                first = -1
            if shape[1:] == rows and {*pixels} == {count * math.prod(rows)}:
                if 0 <= first <= shape[0] - count:
                    return Segment(found, first, count)
        raise Refused(
            f"{self.place}: expected virtual frames that are whole frames of other data sets, got "
            f"others of {path}:{source.dset_name}; h5repack makes one file of them"
        )

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """The frames of increasing numbers."""
        out = np.empty((len(numbers), *self.shape[1:]), self.dtype)
        for part, begin, end in zip(self.parts, self._ends, self._ends[1:], strict=False):
            inside = np.flatnonzero((numbers >= begin) & (numbers < end))
            if not len(inside):
                continue
            wanted = numbers[inside] - begin + part.first
            with opened(part.place.path, EXPECTED) as file:
                stored = dataset_in(part.place.path, file, part.place.name, EXPECTED)
                if stored.dtype.kind not in "iuf" or stored.shape[-2:] != self.shape[1:]:
                    got = f"{stored.dtype} {stored.shape}"
                    raise Refused(f"{part.place}: expected frames {self.shape[1:]}, got {got}")
                if stored.ndim == 2:
                    check_chunks(part.place.path, stored)
                    out[:] = stored[()]
                    continue
                self._check(part.place, stored, wanted)
                breaks = np.flatnonzero(np.diff(wanted) != 1) + 1
                for run, target in zip(
                    np.split(wanted, breaks), np.split(inside, breaks), strict=True
                ):
                    out[target[0] : target[-1] + 1] = stored[run[0] : run[-1] + 1]
        return out

    def _check(self, place: Place, stored: h5py.Dataset, numbers: np.ndarray) -> None:
        """Check the chunks of frames that were not checked before."""
        step = stored.chunks[0] if stored.chunks else len(stored)
        for index in np.unique(numbers - numbers % step).tolist():
            if (place, index) not in self._sound:
                check_chunks(place.path, stored, index)
                self._sound.add((place, index))


class FrameViews(ProjectionStack):
    """Some frames of a data set.

    Args:
        frames: all of them.
        numbers: of these.
        fields: flat and dark fields.
        rig: that the file states.
        folder: other files must be in it, or below.
        exposures: of all frames, by their names.
    """

    def __init__(
        self,
        frames: Frames,
        numbers: np.ndarray,
        fields: dict[str, ProjectionStack] | None = None,
        rig: dict[str, Any] | None = None,
        folder: Path | None = None,
        exposures: Mapping[str, np.ndarray] | None = None,
    ):
        self._exposures = exposures or {}
        self._frames, self._numbers, self._folder = frames, numbers, folder
        names = [f"frame {k}" for k in numbers[: VIEWS + 1].tolist()]
        super().__init__(frames.place.path, names, frames.shape[1:], frames.dtype)
        self.fields, self.rig = fields or {}, rig
        if "flat" in self.fields:
            self.kind = "intensities"

    def exposure(self, name: str) -> np.ndarray | None:
        return self._exposures[name][self._numbers] if name in self._exposures else None

    def field_at(self, name: str) -> ProjectionStack | None:
        place = followed(self._frames.place.path, name, EXPECTED, self._folder)
        if place is None:
            return None
        frames = Frames(place, self._folder or place.path.parent.resolve())
        return FrameViews(frames, np.arange(frames.shape[0]))

    def _block(self, first: int, last: int) -> np.ndarray:
        return self._frames.read(self._numbers[first:last])


def hdf5_views(
    path: Path,
    dataset: str | None = None,
    angles: str | Path | None = None,
    image_key: str | Path | None = None,
    layout: str | None = None,
) -> ProjectionStack:
    """Open the views of an HDF5 file: those of mvrecon-simulate, of NXtomo or Data Exchange, or a
    data set by its name.

    Links are followed to other files in the file's folder, and below.

    Args:
        path: of the file.
        dataset: name of the frames [m v u]; None: those beside an image_key, or /exchange/data.
        angles: name of the angles, of all frames or of the views, in this file or as
            "<file>:<name>" in another; None: rotation_angle of NXtomo, theta of Data Exchange, if
            there.
        image_key: name of the key of each frame, in this or another file; None: the one beside the
            frames, if there.
        layout: "sinogram": frames are images of slices, with the angles as rows.

    Raises:
        FileNotFoundError: nothing is there.
        Refused: not HDF5, no or several frames, keys or angles of another number than frames,
            units of neither angles nor lengths, links to files elsewhere, damage.
    """
    check_file(path, EXPECTED)
    if not h5py.is_hdf5(path):
        raise Refused(f"{path}: not an HDF5 file, or cut short; expected {EXPECTED}")
    with file_errors(path, "cannot be read as HDF5"):
        if dataset is angles is image_key is None:
            place = followed(path, "/views", EXPECTED)
            if place is not None:
                return Hdf5Views(path)
        places = _Layout.of(path, dataset, layout == "sinogram")
        if angles is not None:
            places = places._replace(angles=named(path, angles))
        if image_key is not None:
            places = places._replace(key=named(path, image_key))
        return places.opened(path.parent.resolve())


def named(path: Path, name: str | Path) -> Place:
    """The data set of a name in a file, or of "<file>:<name>".

    Raises:
        Refused: there is none.
    """
    inside = IN_FILE.fullmatch(str(name))
    file, key = (Path(inside["path"]).expanduser(), inside["name"]) if inside else (path, str(name))
    check_file(file, "an HDF5 file")
    if (place := followed(file, key, EXPECTED)) is None:
        raise Refused(f"{file}: has no {key}; it contains {listing(file, EXPECTED)}")
    return place


class _Layout(NamedTuple):
    """Where a file has what."""

    frames: Place
    key: Place | None = None
    angles: Place | None = None
    fields: Sequence[tuple[str, Place]] = ()
    pixel: Sequence[tuple[Place, Place]] = ()
    beam: str | None = "parallel"
    sinogram: bool = False
    exposure: Place | None = None
    monitor: Place | None = None
    moves: Sequence[Place] = ()

    @classmethod
    def of(cls, path: Path, dataset: str | None, sinogram: bool) -> "_Layout":
        """Find it in a file, by the name of the frames if given."""
        wanted = None if dataset is None else named(path, dataset)
        only = None if wanted is None else address(wanted)
        found, lost = {}, []
        with opened(path, EXPECTED) as file:
            beside_key = [group.name for group in groups(file) if "image_key" in group.keys()]  # noqa: SIM118
        for group in sorted(beside_key, key=lambda name: -name.count("/")):  # detector first
            try:
                place = followed(path, f"{group}/data", EXPECTED)
            except MissingFile as error:
                lost.append(error)
                continue
            if place is not None and (key := address(place)) not in found:
                if key == (only or key):
                    found[key] = cls._tomo(path, group, place)
        data = followed(path, "/exchange/data", EXPECTED)
        if data is not None and (key := address(data)) not in found and key == (only or key):
            found[key] = cls._exchange(path, data, sinogram)
        if wanted is not None and not found:
            return cls(wanted, sinogram=sinogram)
        if len(found) != 1:
            if lost and not found:
                raise lost[0]
            places = ", ".join(str(layout.frames) for layout in found.values())
            got = f"frames in {places}; choose by views.dataset=<name>"
            if not found:
                got = f"none; it contains {listing(path, EXPECTED)}"
            raise Refused(f"{path}: expected {EXPECTED}, got {got}")
        return next(iter(found.values()))._replace(sinogram=sinogram)

    @classmethod
    def _tomo(cls, path: Path, group: str, frames: Place) -> "_Layout":
        """Of NXtomo, by the group with the frames and their keys."""

        def first(*names: str) -> Place | None:
            parts = group.strip("/").split("/")
            above = ["/".join(["", *parts[:k]]) for k in range(len(parts), -1, -1)]
            for name in names:
                for start in above:
                    if (place := followed(path, f"{start}/{name}", EXPECTED)) is not None:
                        return place
            return None

        source = first("instrument/source/type", "source/type")
        kind = None if source is None else texts_at([source], "", EXPECTED).get(source)
        parallel = kind is None or PARALLEL.search(kind)
        for axis, option in (("x", "columns"), ("y", "rows")):
            flipped = _there(path, f"{group}/{axis}_flipped")
            if flipped is not None and values_at(flipped, EXPECTED).any():
                warnings.warn(
                    f"{flipped}: the {option} of the frames are mirrored; without "
                    f"views.flip_{option}=true so is the volume",
                    stacklevel=2,
                )
        for name, option in (("pixel_mask", "bad_pixels"), ("saturation_value", "saturation")):
            if (stated := _there(path, f"{group}/{name}")) is not None:
                warnings.warn(f"{stated}: is not applied; give it as views.{option}", stacklevel=2)
        key = followed(path, f"{group}/image_key_control", EXPECTED)
        sizes = [
            [first(f"sample/{axis}_pixel_size"), followed(path, f"{group}/{axis}_pixel_size", "")]
            for axis in "yx"
        ]
        pairs = [(y, x) for y, x in zip(*sizes, strict=True) if y is not None and x is not None]
        return cls(
            frames,
            key or followed(path, f"{group}/image_key", EXPECTED),
            first("sample/rotation_angle", "data/rotation_angle", "rotation_angle"),
            (),
            pairs,
            "parallel" if parallel else None,
            exposure=_there(path, f"{group}/count_time"),
            monitor=_there(path, f"{group.rpartition('/instrument')[0]}/control/data"),
            moves=[p for axis in "xyz" if (p := first(f"sample/{axis}_translation")) is not None],
        )

    @classmethod
    def _exchange(cls, path: Path, frames: Place, sinogram: bool) -> "_Layout":
        """Of Data Exchange."""
        order = "y:theta:x" if sinogram else "theta:y:x"
        axes = texts_at([frames], "axes", EXPECTED).get(frames)
        if axes is not None and axes.replace(" ", "") != order:
            raise Refused(
                f"{frames}: expected the axes {order}, got {shown(axes)}; views.layout=sinogram is "
                f"for y:theta:x"
            )
        places = {
            name: followed(path, f"/exchange/{name}", EXPECTED)
            for name in ("data_white", "data_dark", "theta")
        }
        kept = [("flat", places["data_white"]), ("dark", places["data_dark"])]
        return cls(frames, None, places["theta"], [(n, p) for n, p in kept if p is not None])

    def opened(self, folder: Path) -> FrameViews:
        """The views, with fields and rig."""
        frames = Frames(self.frames, folder)
        keys = np.zeros(frames.shape[0], int)
        if self.key is not None and self.sinogram:
            raise Refused(f"{self.key}: expected no keys of sinograms, got some")
        if self.key is not None:
            keys = values_at(self.key, EXPECTED)
            if keys.shape != (frames.shape[0],):
                raise Refused(
                    f"{self.key}: expected a key for each of {frames.shape[0]} frames, got "
                    f"{keys.shape}"
                )
            if unknown := sorted({*keys.tolist()} - {VIEW, FLAT, DARK, INVALID, ALIGNMENT}):
                raise Refused(
                    f"{self.key}: expected keys 0 (views), 1 (flat), 2 (dark), 3 (invalid) or -1 "
                    f"(alignment), got {shown(unknown)}"
                )
        exposures = {}
        for name, place in (("count_time", self.exposure), ("control/data", self.monitor)):
            if place is not None:
                values = values_at(place, EXPECTED, ("units",)).ravel().astype(float)
                if len(values) == len(keys):
                    exposures[name] = values
        fields: dict[str, ProjectionStack] = {
            name: FrameViews(frames, np.flatnonzero(keys == key), exposures=exposures)
            for name, key in (("flat", FLAT), ("dark", DARK))
            if (keys == key).any()
        }
        for name, place in self.fields:
            others = Frames(place, folder)
            fields[name] = FrameViews(others, np.arange(others.shape[0]))
        for name, others in (("count_time", (FLAT, DARK)), ("control/data", (FLAT,))):
            if name in exposures:
                _warn_of_change(f"{frames.place.path}: {name}", exposures[name], keys, others)
        views = np.flatnonzero(keys == VIEW)
        rig: dict[str, Any] = {"name": self.beam if self.angles else None, "detector": {}}
        lengths = [place for pair in self.pixel for place in pair]
        angles = [] if self.angles is None else [self.angles]
        units = texts_at([*angles, *lengths], "units", EXPECTED)
        if angles:
            turns = np.zeros(frames.shape[1], int) if self.sinogram else keys
            rig["angles"] = self._degrees(turns, units)
        if (pixel := self._pixel_mm(units)) is not None:
            rig["detector"]["pixel_mm"] = pixel
        for place in self.moves:
            moved = values_at(place, EXPECTED, ("units", *TRANSFORMATION)).ravel()
            far = np.ptp(moved[views]) if len(moved) == len(keys) and len(views) else 0
            unit = texts_at([place], "units", EXPECTED).get(place)
            if far and not (
                pixel and unit and far * millimetres(place, unit) < MAX_MOVE_PX * min(pixel)
            ):
                warnings.warn(
                    f"{place}: the sample moved by {far:g}{f' {unit}' if unit else ''} between "
                    f"views, which the rig does not follow; calibrate=[shifts] fits shifts",
                    stacklevel=2,
                )
        return FrameViews(frames, views, fields, rig, folder, exposures)

    def _degrees(self, keys: np.ndarray, units: dict[Place, str]) -> list[float]:
        """The angles of the views in degrees."""
        place, kept = self.angles, keys == VIEW
        assert place is not None
        values = values_at(place, EXPECTED, ("units", *TRANSFORMATION))
        if values.size not in (len(keys), kept.sum()) or values.size != max(values.shape):
            raise Refused(
                f"{place}: expected an angle for each of {len(keys)} frames"
                f"{'' if kept.all() else f', or of {kept.sum()} views'}, got {values.shape}"
            )
        degrees = values.ravel().astype(float)
        degrees = degrees[kept] if len(degrees) == len(keys) else degrees
        if not np.isfinite(degrees).all():
            raise Refused(f"{place}: expected finite angles of the views, got {shown(degrees)}")
        unit = units.get(place)
        factor = 1.0 if unit is None else DEGREES.get(unit.strip().lower())
        if factor is None:
            raise Refused(f"{place}: expected units of {', '.join(DEGREES)}, got {shown(unit)}")
        degrees *= factor
        with file_errors(place.path, f"{place.name} is no turn", "give views.angles"):
            check_turning(degrees.tolist())
            if unit is None:
                check_degrees(degrees.tolist(), False, "angles without units")
        if unit is not None:
            try:
                check_degrees(degrees.tolist(), False, "angles")
            except ValueError as error:
                warnings.warn(f"{place}: {error}", stacklevel=2)
        return degrees.tolist()

    def _pixel_mm(self, units: dict[Place, str]) -> tuple[float, float] | None:
        """Rows' and columns' pitch; None if the file has none with units."""
        for pair in self.pixel:
            sizes = []
            for place in pair:
                values = np.unique(values_at(place, EXPECTED, ("units",)))
                if not (unit := units.get(place)):
                    warnings.warn(f"{place}: has no units, and is not used", stacklevel=2)
                elif len(values) == 1 and values[0] > 0:
                    sizes.append(float(values[0]) * millimetres(place, unit))
                else:
                    raise Refused(f"{place}: expected one positive size, got {shown(values)}")
            if len(sizes) == 2:
                return sizes[0], sizes[1]
        return None


def _there(path: Path, name: str) -> Place | None:
    """A data set that is not needed: None as well if it is in a file that is not there."""
    try:
        return followed(path, name, EXPECTED)
    except MissingFile:
        return None


def _warn_of_change(what: str, values: np.ndarray, keys: np.ndarray, others: Sequence[int]) -> None:
    """Warn of fields that were taken with another exposure, or in another beam, than views."""
    views = values[keys == VIEW]
    for key in others:
        if not (keys == key).any() or not (mean := values[keys == key].mean()) > 0:
            continue
        ratio = views / mean
        if np.abs(ratio - 1).max() > MAX_CHANGE:
            warnings.warn(
                f"{what}: of the views is {ratio.min():.4g} to {ratio.max():.4g} times that of the "
                f"{'flat' if key == FLAT else 'dark'} fields, which is not corrected "
                + (f"but by views.exposure={what.split()[-1]}" if key == FLAT else "of the dark"),
                stacklevel=2,
            )
