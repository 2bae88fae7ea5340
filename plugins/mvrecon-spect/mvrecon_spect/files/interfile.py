"""Interfile: a text header with `key := value` lines, and the data in a separate file beside it.

Keys as in Interfile 3.3 (Todd-Pokropek, Cradduck & Deconinck, Nucl. Med. Commun. 13 (1992) 673) and
in STIR (`standardise_interfile_keyword`): case and "!" are ignored, blanks and "_" separate words,
"[1]" is an index, ";" begins a comment, and a backslash at the end continues a line. "%" begins a
vendor's own key.
"""

import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import EDGE, VOLUME, Refused, file_beside, plain_name, shown, text_of
from mvrecon.core.files.keys import Key, check_keys, check_unknown
from mvrecon.core.files.prose import stated_effects
from mvrecon.core.registry import hint
from mvrecon.geometry.cameras.formats.common import number
from mvrecon_spect.files.interfile_keys import (
    CONTENT,
    EFFECT,
    EFFECTS,
    KEYS,
    SECTIONS,
    SPELLINGS,
    TEXTS,
    Content,
)

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


@dataclass(frozen=True)
class Header:
    """Values of an Interfile header by key, spelled "matrix size [1]" and without an optional [1];
    errors of `text`, `number` and `whole` contain the path.
    """

    path: Path
    values: Mapping[str, str]

    def text(self, key: str, default: str | None = None) -> str:
        """The value of a key in lower case.

        Raises:
            Refused: the key is missing and there is no default.
        """
        value = self.values.get(key) or default
        if value is None:
            raise Refused(
                f"{self.path}: expected the key {key!r}, got none{hint(key, self.values)}"
            )
        return value.strip().lower()

    def number(self, key: str, default: float | None = None) -> float:
        """The value of a key as a finite number.

        Raises:
            Refused: not a number, or the key is missing and there is no default.
        """
        text = self.text(key, None if default is None else repr(default))
        return number_in(self.path, text, repr(key))

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


def number_in(path: Path, text: str, what: str) -> float:
    """A finite number in a file's text.

    Raises:
        Refused: not a number.
    """
    try:
        return number(text, what)
    except ValueError as error:
        raise Refused(f"{path}: {error}") from None


def read_header(path: str | Path, content: Content) -> Header:
    """Read an Interfile header, and check the keys that change values or places.

    Args:
        path: path of the header.
        content: kind of the file, which determines its keys: `KEYS` and `CONTENT[content]`.

    Raises:
        FileNotFoundError: the file does not exist.
        Refused: the file is no Interfile header or is truncated; a key has two values, or a value
            that its table refuses; a known key has "%" or an index that it does not have; or an
            unknown key contains a word of `EFFECT` or is a known one with a misspelling.

    Warns:
        UserWarning: the header has no end, although its last line is complete; or it has other
            unknown keys.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected an Interfile header")
    text = text_of(path, strict=False)
    text = re.sub(r"\\\r?\n", "", text)
    lines = [line.partition(";")[0].strip() for line in text.splitlines()]
    pairs = [(_name(key), value) for key, mark, value in (x.partition(":=") for x in lines) if mark]
    names = [name.base for name, _ in pairs]
    open_ended = STOP not in names and text.endswith("\n")
    if names[:1] != [START] or not (open_ended or names[-1] == STOP):
        raise Refused(
            f"{path}: expected an Interfile header from '!INTERFILE :=' to '!END OF INTERFILE :=', "
            f"got {shown(names[:1] + names[-1:])}; is it cut short?"
        )
    if open_ended:
        warnings.warn(
            f"{path}: has no '!END OF INTERFILE :=' behind its last key, {names[-1]!r}; is it cut "
            f"short?",
            stacklevel=3,
        )
    table: dict[str, dict[int | str | None, Key]] = {}
    for key in (*KEYS, *CONTENT[content]):
        for name in map(_name, key.names):
            table.setdefault(name.base, {})[name.index] = key
    values: dict[str, str] = {}
    for name, value in pairs:
        one = name.index == 1 and None in table.get(name.base, {})
        spelled = str(name._replace(index=None) if one else name)
        value = value.strip()
        if values.setdefault(spelled, value) != value:
            raise Refused(_two_values(path, spelled, values[spelled], value, pairs))
    for name, value in pairs:
        _check_key(path, name, value.strip(), table)
    unknown = [(str(name), value.strip()) for name, value in pairs if name.base not in table]
    for line in lines:
        name = _name(re.split(r":\s*=|[:=]", line)[0])
        if ":=" in line and name.base == STOP:
            break  # CASToR copies lines of its input behind the end
        if ":=" in line or not line:
            continue
        if _used(name, table) or EFFECT.search(str(name)):
            raise Refused(f"{path}: expected '{name} := value', got {shown(line)}")
        unknown += [(str(name), line)] * (name.base not in table)
    texts = [(name.base, value) for name, value in pairs if name.base in TEXTS]
    check_unknown(path, unknown, (*KEYS, *CONTENT[content]), EFFECTS, stated_effects(texts))
    return Header(path, values)


class _Name(NamedTuple):
    """A key in lower case with single blanks and without "!", its index, and whether it is a
    vendor's. An index that is no whole number is kept as text.
    """

    base: str
    index: int | str | None = None
    vendor: bool = False

    def __str__(self) -> str:
        index = self.index if isinstance(self.index, str) else f"[{self.index}]"
        return "%" * self.vendor + self.base + (f" {index}" if self.index is not None else "")


def _name(key: str) -> _Name:
    words = re.sub(r"[\s_!]+", " ", key).strip().lower()
    base, bracket, rest = words.lstrip("% ").partition("[")
    number = re.fullmatch(r" ?([0-9]{1,9}) ?\]", rest)
    index = int(number[1]) if number else f"[{rest}" if bracket else None
    for other, spelling in SPELLINGS.items():
        base = base.replace(other, spelling)
    return _Name(base.strip(), index, words.startswith("%"))


def _used(name: _Name, table: Mapping[str, Mapping[int | str | None, Key]]) -> bool:
    return any(key.use != "ignored" for key in table.get(name.base, {}).values())


def _check_key(
    path: Path, name: _Name, value: str, table: Mapping[str, Mapping[int | str | None, Key]]
) -> None:
    """Check the use of one key by the table, whose keys are a base and its indices."""
    indices = table.get(name.base, {})
    key = indices.get(name.index)
    if key is None and (set(indices) - {None} or _used(name, table)):
        known = [str(name._replace(index=index, vendor=False)) for index in indices]
        raise Refused(
            f"{path}: expected {' or '.join(map(repr, known))}, got {str(name)!r} := {value!r}; "
            f"correct the index, or write a file for each image"
        )
    if name.vendor and key is not None and key.use in ("applied", "compared"):
        raise Refused(
            f"{path}: expected {str(name).lstrip('%')!r}, got the vendor's key {str(name)!r} := "
            f"{value!r}; remove the '%' if it means the same, else apply it and remove the key"
        )
    if key is not None:
        check_keys(path, [key], lambda _: value)


def _two_values(
    path: Path, key: str, first: str, second: str, pairs: Sequence[tuple[_Name, str]]
) -> str:
    """The message for a key with two values: remove one, or split the header's sections."""
    stated = {name.base: value.strip() for name, value in pairs}
    sections = [f"{name!r} := {stated[name]}" for name in SECTIONS if stated.get(name, "1") != "1"]
    cure = (
        f"the header has a section for each of {' and '.join(sections)}: expected one, write a "
        f"file for each"
        if sections
        else "remove the wrong one"
    )
    return f"{path}: expected one value of {key!r}, got {first!r} and {second!r}; {cure}"


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


def check_repeated(
    header: Header, names: Sequence[str], expected: float, what: str, tolerance: float = 0.0
) -> None:
    """Check keys that repeat a number, where the header has them.

    Args:
        header: header of the file.
        names: names of the keys.
        expected: their number.
        what: its origin, for the message.
        tolerance: relative.

    Raises:
        Refused: another number; the message names the key.
    """
    for name in names:
        if header.values.get(name):
            if abs((got := header.number(name)) - expected) > tolerance * abs(expected):
                raise Refused(f"{header.path}: expected {name!r} {expected:g}, {what}, got {got:g}")


def numbers_of(header: Header, shape: Sequence[int]) -> Numbers:
    """The data of a header.

    Args:
        header: contains file name, number type, byte order (Interfile's default: big endian) and
            offset.
        shape: the last axis varies fastest.

    Raises:
        FileNotFoundError: the data file does not exist.
        Refused: a path outside the header's folder, an unknown number format, or a file whose size
            does not match header and shape.
    """
    words = header.text("number format"), header.whole("number of bytes per pixel")
    order = ORDERS.get(header.text("imagedata byte order", "bigendian"))
    if words not in FORMATS or order is None:
        raise Refused(
            f"{header.path}: expected a number format of {shown(sorted(map(str, FORMATS)))} and "
            f"the byte order LITTLEENDIAN or BIGENDIAN, got {words} and "
            f"{header.text('imagedata byte order', 'bigendian')!r}"
        )
    block = header.whole("data starting block", 0)
    offset = header.whole("data offset in bytes", 2048 * block)
    check_repeated(header, ["data starting block"], offset / 2048, "by the offset in bytes")
    dtype = np.dtype(order + FORMATS[words])
    if max(shape) > EDGE or math.prod(shape) * max(8, dtype.itemsize) > VOLUME:
        raise Refused(
            f"{header.path}: expected at most {VOLUME} bytes, {EDGE} along an axis, got "
            f"{tuple(shape)}"
        )
    if not (stated := header.values.get("name of data file")):
        raise Refused(f"{header.path}: expected the key 'name of data file', got none")
    path = file_beside(header.path, stated)
    needed, size = offset + math.prod(shape) * dtype.itemsize, path.stat().st_size
    if needed != size:
        raise Refused(
            f"{header.path}: expected {needed} bytes in {path.name} ({tuple(shape)} of {dtype} "
            f"from byte {offset} on), got {size}; is it cut short, or another format?"
        )
    scale = header.number("image scaling factor", 1.0)
    units = header.number("quantification units", 1.0)
    if 1.0 not in (scale, units) and scale != units:
        raise Refused(
            f"{header.path}: expected 'quantification units' equal to the image scaling factor "
            f"{scale:g}, or one of them 1, got {units:g}"
        )
    if 0.0 in (scale, units):
        raise Refused(
            f"{header.path}: expected 'image scaling factor' and 'quantification units' other than "
            f"0, got {scale:g} and {units:g}; remove the unknown one"
        )
    return Numbers(path, dtype, offset, tuple(shape), scale if scale != 1 else units)


def write_interfile(
    path: str | Path, ending: str, lines: Sequence[str], values: np.ndarray
) -> None:
    """Write a header and its data as little-endian float32; both are whole on the disk
    before either replaces a file, the header last.

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
    with written_whole(path) as header:
        with header.open("w", encoding="utf-8") as file:
            file.write("\n".join(head) + "\n")
            file.flush()
            os.fsync(file.fileno())
        with written_whole(data) as part:
            np.ascontiguousarray(values, "<f4").tofile(part)
