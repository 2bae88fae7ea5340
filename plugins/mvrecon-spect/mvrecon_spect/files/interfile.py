"""Interfile: a text header with `key := value` lines, and the data in a separate file beside it.

Keys as in Interfile 3.3 (Todd-Pokropek, Cradduck & Deconinck, Nucl. Med. Commun. 13 (1992) 673) and
in STIR: case, blanks and a leading "!" are ignored, ";" begins a comment.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import EDGE, VOLUME, Refused, plain_name, shown, text_of
from mvrecon.core.files.keys import Key, check_keys
from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.formats.common import number

#: Dtypes by the header's number format and bytes per number.
FORMATS = {
    ("float", 4): "f4",
    ("float", 8): "f8",
    ("short float", 4): "f4",
    ("long float", 8): "f8",
    **{("signed integer", size): f"i{size}" for size in (1, 2, 4)},
    **{("unsigned integer", size): f"u{size}" for size in (1, 2, 4)},
}
ORDERS = {"littleendian": "<", "bigendian": ">"}
START, STOP = "interfile", "end of interfile"
Content = Literal["projections", "volume"]
#: Keys of a header of any content; of those with an index, [1] is meant where none is given.
KEYS = (
    Key("name of data file", "applied", "beside the header"),
    *(Key(name, "applied") for name in ("number format", "number of bytes per pixel")),
    Key("imagedata byte order", "applied", "big endian if missing"),
    Key("data offset in bytes", "applied", "with [1] as without"),
    Key("data starting block", "compared", "with the offset, which is 2048 bytes a block"),
    Key("image scaling factor", "applied", "with [1] as without; one for all planes"),
    Key("quantification units", "applied", "as in STIR: the image scaling factor, or equal to it"),
    Key("data rescale slope", "refused", "multiply the values by it", (1,)),
    Key("data rescale offset", "refused", "add it to the values", (0,)),
    Key("rescale slope", "refused", "multiply the values by it", (1,)),
    Key("rescale intercept", "refused", "add it to the values", (0,)),
    Key("matrix size", "applied"),
    Key("scaling factor (mm/pixel)", "applied"),
    Key("number of time frames", "refused", "one frame in a file", (1,)),
    Key("number of time windows", "refused", "one window in a file", (1,)),
    Key("number of energy windows", "refused", "one window in a file", (1,)),
    Key("number of windows", "refused", "one window in a file", (1,)),
    Key("number of image data types", "refused", "one type in a file", (1,)),
    Key("number of detector heads", "refused", "join the heads' projections", (1,)),
    Key("data compression", "refused", "plain numbers", ("none",)),
    Key("data encode", "refused", "plain numbers", ("none",)),
    Key("type of data", "refused", "", ("tomographic", "static", "pet", "other")),
    Key("originating system", "applied", "mvrecon: every offset is a position"),
    Key("imaging modality, version of keys", "ignored", "origin"),
    Key("patient orientation, patient rotation", "ignored", "world states the axes"),
    Key("maximum pixel count, minimum pixel count", "ignored", "statistics"),
    Key("energy window lower level, energy window upper level", "ignored", "of the physics"),
    Key(
        "start horizontal bed position (mm), start vertical bed position (mm)",
        "ignored",
        "as in STIR's projectors",
    ),
    Key("flood corrected", "ignored", "as cameras do"),
)
#: Keys of one content besides `KEYS`.
CONTENT: dict[Content, tuple[Key, ...]] = {
    "projections": (
        Key("number of projections", "applied"),
        Key("number of dimensions", "refused", "rows and columns of each view", (2, 3)),
        Key("matrix size [3]", "compared", "with the number of projections"),
        Key("total number of images", "compared", "with the number of projections"),
        Key("matrix axis label [1]", "refused", "", ("bin coordinate",)),
        Key("matrix axis label [2]", "refused", "", ("axial coordinate",)),
        Key("matrix axis label [3]", "refused", "", ("view",)),
        Key("process status", "refused", "measured views", ("acquired",)),
        Key("PET data type", "refused", "counts", ("emission",)),
        Key("decay corrected", "refused", "counts as measured", ("n", "no", "0")),
        Key("attenuation corrected", "refused", "counts as measured", ("n", "no", "0")),
        Key("scatter corrected", "refused", "counts as measured", ("n", "no", "0")),
        Key("applied corrections", "refused", "counts as measured", ("none", "{none}", "{}")),
        Key("direction of rotation", "compared", "with STIR's detector file"),
        Key("start angle", "compared", "with STIR's detector file"),
        Key("extent of rotation", "compared", "with STIR's detector file"),
        Key("orbit", "refused", "", ("circular",)),
        Key("radius", "applied", "of STIR's pinhole systems"),
        Key("radii", "refused", "circular orbit"),
        Key("x offset", "refused", "centred detectors", (0,)),
        Key("y offset", "refused", "centred detectors", (0,)),
        Key("calibration factor", "ignored", "of activities; views are counts"),
    ),
    "volume": (
        Key("number of dimensions", "refused", "x, y, z", (3,)),
        Key("matrix axis label [1]", "refused", "", ("x",)),
        Key("matrix axis label [2]", "refused", "", ("y",)),
        Key("matrix axis label [3]", "refused", "", ("z",)),
        Key("number of slices", "compared", "with matrix size [3]"),
        Key("total number of images", "compared", "with matrix size [3]"),
        Key(
            "centre-centre slice separation (pixels)",
            "compared",
            "with the scaling factors [3] and [1]",
        ),
        Key("first pixel offset (mm)", "applied", "unless place=centred"),
        Key("slice orientation", "refused", "x, y, z", ("transverse",)),
        Key("process status", "refused", "a volume", ("reconstructed",)),
        Key("PET data type", "refused", "a volume", ("image",)),
        Key("calibration factor", "refused", "multiply the values by it", (1, 0, -1)),
    ),
}
#: Words of keys that change values or places; a key with one that is not in the tables is refused.
EFFECT = re.compile(
    r"\b(scal\w*|rescal\w*|slope|intercept|factors?|calibrat\w*|quanti\w*|units?|offsets?|origin|"
    r"shift\w*|compress\w*|encod\w*|zoom|flip\w*|mirror\w*|transpos\w*)\b"
)
#: Numbers of sections of a header; each section repeats its keys.
SECTIONS = (
    "number of detector heads",
    "number of energy windows",
    "number of windows",
    "number of time frames",
    "number of time windows",
    "number of frame groups",
    "number of image data types",
)


@dataclass(frozen=True)
class Header:
    """Keys and text values of an Interfile header; errors of `text`, `number` and `whole` contain
    the path.
    """

    path: Path
    values: Mapping[str, str]

    def text(self, key: str, default: str | None = None) -> str:
        """The value of a key in lower case.

        Raises:
            Refused: the key is missing and there is no default.
        """
        value = self.values.get(_key(key)) or default
        if value is None:
            raise Refused(
                f"{self.path}: expected the key {key!r}, got none{hint(_key(key), self.values)}"
            )
        return value.strip().lower()

    def number(self, key: str, default: float | None = None) -> float:
        """The value of a key as a finite number.

        Raises:
            Refused: not a number, or the key is missing and there is no default.
        """
        try:
            return number(self.text(key, None if default is None else repr(default)), repr(key))
        except ValueError as error:
            raise (
                error if isinstance(error, Refused) else Refused(f"{self.path}: {error}")
            ) from None

    def positive(self, key: str, default: float | None = None) -> float:
        """The value of a key as a positive number.

        Raises:
            Refused: not a positive number, or the key is missing.
        """
        if not (value := self.number(key, default)) > 0:
            raise Refused(f"{self.path}: expected a positive {key!r}, got {value:g}")
        return value

    def whole(self, key: str, default: int | None = None) -> int:
        """The value of a key as a non-negative integer.

        Raises:
            Refused: not an integer from 0 to 2^40, or the key is missing.
        """
        value = self.number(key, default)
        if value != int(value) or not 0 <= value < 2**40:
            raise Refused(f"{self.path}: expected a whole number for {key!r}, got {value:g}")
        return int(value)


def read_header(path: str | Path) -> Header:
    """Read the keys and values of an Interfile header.

    Raises:
        FileNotFoundError: the file does not exist.
        Refused: not an Interfile header, a truncated one, or a key with two values.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected an Interfile header")
    pairs = [
        (_key(key), value.strip())
        for line in text_of(path).splitlines()
        for key, mark, value in [line.partition(";")[0].partition(":=")]
        if mark
    ]
    if not pairs or pairs[0][0] != START or pairs[-1][0] != STOP:
        raise Refused(
            f"{path}: expected an Interfile header from '!INTERFILE :=' to '!END OF INTERFILE :=', "
            f"got {shown([key for key, _ in pairs[:1] + pairs[-1:]])}; is it cut short?"
        )
    values: dict[str, str] = {}
    for key, value in pairs:
        if values.setdefault(key, value) != value:
            several = {name: dict(pairs).get(name, "1") for name in SECTIONS}
            sections = [f"{name!r} := {n}" for name, n in several.items() if n != "1"]
            cure = (
                f"; the header has a section for each of {' and '.join(sections)}: expected one, "
                f"write a file for each"
                if sections
                else "; remove the wrong one"
            )
            raise Refused(
                f"{path}: expected one value of {key!r}, got {values[key]!r} and {value!r}{cure}"
            )
    return Header(path, values)


@dataclass(frozen=True)
class Numbers:
    """The data of an Interfile, checked against the size of its file.

    Args:
        path: path of the data.
        dtype: stored dtype.
        offset: bytes before the first number.
        shape: the last axis varies fastest.
        scale: factor applied to every number.
    """

    path: Path
    dtype: np.dtype
    offset: int
    shape: tuple[int, ...]
    scale: float

    def read(self, first: int, last: int) -> np.ndarray:
        """Items `first` to `last - 1` along the first axis, scaled, float32."""
        item = math.prod(self.shape[1:])
        offset = self.offset + first * item * self.dtype.itemsize
        values = np.fromfile(self.path, self.dtype, (last - first) * item, offset=offset)
        if len(values) != (last - first) * item:
            raise Refused(f"{self.path}: expected items {first} to {last - 1}, got a shorter file")
        scaled = values.astype(np.float64) * self.scale
        return scaled.astype(np.float32).reshape(last - first, *self.shape[1:])


def check_header(header: Header, content: Content) -> None:
    """Check the keys of a header that change values or places.

    Raises:
        Refused: a key to refuse by `KEYS` or `CONTENT`, or an unknown one with a word of `EFFECT`;
            or a key without index that contradicts the same with [1].
    """
    keys = (*KEYS, *CONTENT[content])
    check_keys(header.path, keys, lambda name: header.values.get(_key(name)))
    known = {re.sub(r"\[.*", "", _key(n)) for key in keys for n in key.name.split(", ")}
    for key, value in header.values.items():
        name, index = re.fullmatch(r"([^\[]*)(.*)", key.lstrip("%")).groups()  # type: ignore[union-attr]
        if name not in known and EFFECT.search(name):
            raise Refused(
                f"{header.path}: expected keys whose effect is known, got {key!r} := {value!r}; "
                f"apply it, and remove the key"
            )
        if index == "[1]" and header.values.get(name, value) != value:
            raise Refused(
                f"{header.path}: expected one value of {name!r} and {key!r}, got "
                f"{header.values[name]!r} and {value!r}"
            )


def check_repeated(header: Header, names: Sequence[str], expected: float, what: str) -> None:
    """Check keys that repeat a number, where the header has them.

    Raises:
        Refused: another number; the message names the key.
    """
    for name in names:
        if header.values.get(_key(name)) and (got := header.number(name)) != expected:
            if abs(got - expected) > 1e-3 * abs(expected):
                raise Refused(f"{header.path}: expected {name!r} {expected:g}, {what}, got {got:g}")


def numbers_of(header: Header, shape: Sequence[int], content: Content) -> Numbers:
    """The data of a header.

    Args:
        header: contains file name, number type, byte order (Interfile's default: big endian) and
            offset.
        shape: the last axis varies fastest.
        content: of the file, which determines its keys.

    Raises:
        FileNotFoundError: the data file does not exist.
        Refused: a path outside the header's folder, an unknown number format, a file whose size
            does not match header and shape, or a key to refuse; see `check_header`.
    """
    check_header(header, content)
    words = header.text("number format"), header.whole("number of bytes per pixel")
    order = ORDERS.get(header.text("imagedata byte order", "bigendian"))
    if words not in FORMATS or order is None:
        raise Refused(
            f"{header.path}: expected a number format of {shown(sorted(map(str, FORMATS)))} and "
            f"the byte order LITTLEENDIAN or BIGENDIAN, got {words} and "
            f"{header.text('imagedata byte order', 'bigendian')!r}"
        )
    block = 2048 * header.whole("data starting block", 0)
    offset = header.whole("data offset in bytes", header.whole("data offset in bytes[1]", block))
    check_repeated(header, ["data starting block"], offset / 2048, "by the offset in bytes")
    dtype = np.dtype(order + FORMATS[words])
    if max(shape) > EDGE or math.prod(shape) * max(8, dtype.itemsize) > VOLUME:
        raise Refused(
            f"{header.path}: expected at most {VOLUME} bytes, {EDGE} along an axis, got "
            f"{tuple(shape)}"
        )
    path = _data_file(header)
    needed, size = offset + math.prod(shape) * dtype.itemsize, path.stat().st_size
    if needed != size:
        raise Refused(
            f"{header.path}: expected {needed} bytes in {path.name} ({tuple(shape)} of {dtype} "
            f"from byte {offset} on), got {size}; is it cut short, or another format?"
        )
    scale = header.number("image scaling factor[1]", header.number("image scaling factor", 1.0))
    units = header.number("quantification units[1]", header.number("quantification units", 1.0))
    if 1.0 not in (scale, units) and scale != units:
        raise Refused(
            f"{header.path}: expected 'quantification units' equal to the image scaling factor "
            f"{scale:g}, or one of them 1, got {units:g}"
        )
    return Numbers(path, dtype, offset, tuple(shape), scale if scale != 1 else units)


def write_interfile(
    path: str | Path, ending: str, lines: Sequence[str], values: np.ndarray
) -> None:
    """Write a header and its data as little-endian float32; each file is replaced atomically, the
    header last.

    Args:
        path: path of the header.
        ending: file extension of the data file, which otherwise has the header's name.
        lines: header lines besides those about the data.
        values: the last axis varies fastest.
    """
    path = Path(path).expanduser()
    data = path.with_suffix(ending)
    if ";" in plain_name(data.name, path) or data.name != data.name.strip():
        raise Refused(
            f"{path}: expected a name without ';' (a comment in Interfile) and without blanks at "
            f"its ends, got {data.name!r}"
        )
    head = [
        "!INTERFILE :=",
        f"name of data file := {data.name}",
        "!data offset in bytes := 0",
        "imagedata byte order := LITTLEENDIAN",
        "!number format := float",
        "!number of bytes per pixel := 4",
        *lines,
        "!END OF INTERFILE :=",
    ]
    with written_whole(data) as part:
        np.ascontiguousarray(values, "<f4").tofile(part)
    with written_whole(path) as part:
        part.write_text("\n".join(head) + "\n", encoding="utf-8")


def _key(key: str) -> str:
    """Normalise a key: lower case, no leading "!", no insignificant blanks."""
    words = re.sub(r"[\s_]+", " ", key.strip().lstrip("!").strip().lower())
    return re.sub(r"\s*\[\s*(\d+)\s*\]", r"[\1]", words)


def _data_file(header: Header) -> Path:
    """The data file in the header's folder."""
    if not (stated := header.values.get("name of data file")):
        raise Refused(f"{header.path}: expected the key 'name of data file', got none")
    path = header.path.parent / plain_name(stated, header.path)
    if path.is_symlink():
        raise Refused(f"{header.path}: expected its data beside it, got a link, {path.name}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected the data of {header.path.name}")
    return path
