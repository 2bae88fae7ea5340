"""Projections as PNG, by Pillow."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mvrecon.core.files.checks import EDGE, Refused
from mvrecon.core.files.keys import Key, check_keys, unknown_names
from mvrecon.data.projections import descriptions
from mvrecon.data.projections.stack import Header
from mvrecon.data.projections.tiff import EXIF_BEAM, TIFF_KEYS

#: Pixel types of a grey PNG by Pillow's mode.
MODES = {"1": "?", "L": "u1", "I;16": "u2", "I;16B": "u2", "I": "i4"}
#: Tag of the camera's part of EXIF.
CAMERA = 0x8769
#: Chunks of texts.
TEXTS = ("tEXt", "zTXt", "iTXt")
#: Chunks and fields of PNG that change the pixels, and those that ordinary files have; a warning
#: names all others.
PNG_KEYS = (
    Key("IHDR, IDAT, IEND", "applied"),
    Key("bit depth", "refused", "1 in masks alone; Pillow rescales 2 and 4 bits", (1, 8, 16)),
    Key("colour type", "refused", "grey values", (0,)),
    Key("interlace method", "applied"),
    Key("acTL", "refused", "one image in each file"),
    Key("pCAL", "refused", "store the values that the calibration gives"),
    Key("sTER", "refused", "one image, not a pair beside each other"),
    Key("eXIf: Orientation", "refused", "the first pixel is at the upper left", (1,)),
    Key("eXIf: Gamma", "refused", "linear values", (1,)),
    Key(
        ", ".join(f"eXIf: {name}" for name in ("ExposureTime", *EXIF_BEAM)),
        "compared",
        "of all views and of flat fields, as those of TIFF",
    ),
    Key(
        "text: ...",
        "ignored",
        "what programs state; a warning names it, but entries of 0, off or nothing",
    ),
    Key(", ".join(TEXTS), "ignored", "chunks of these texts"),
    Key(
        "gAMA, sRGB, iCCP, cICP, cHRM, tRNS, bKGD, PLTE, sPLT, hIST, mDCV, cLLI",
        "ignored",
        "display alone",
    ),
    Key(
        "tIME, eXIf, dSIG, iDOT, vpAg, caNv, gIFg, gIFx",
        "ignored",
        "date, origin, canvas and order of writing",
    ),
    Key("pHYs, oFFs, sCAL", "ignored", "origin and print size"),
    Key("sBIT", "ignored", "values of fewer bits are scaled to all bits"),
)
#: Keys of EXIF, which are tags of TIFF: of those to refuse there, the others are named.
EXIF_KEYS = [key for key in TIFF_KEYS if key.use != "refused"]
#: Passes of a plain and of an interlaced PNG: first column and row, and their steps.
PLAIN = [(0, 0, 1, 1)]
INTERLACED = [
    *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2)),
    (0, 1, 1, 2),
]


def png_header(file: Path) -> Header:
    """Header of a PNG; raises Refused for colours and for `PNG_KEYS` to refuse."""
    with _png(file) as image:
        columns, rows = image.size
        with file.open("rb") as raw:
            bits, colours = struct.unpack_from("BB", raw.read(26), 24)
        chunks = dict.fromkeys((name for name, _ in _chunks(file)), "one")
        stated = {"bit depth": bits, "colour type": colours, **chunks}
        exif = _exif(image) if "eXIf" in chunks else {}
        stated |= {f"eXIf: {name}": value for name, value in exif.items()}
        check_keys(file, PNG_KEYS, stated.get)
        texts = [*image.text.items()] if {*TEXTS} & {*chunks} else []
        texts.append(("ImageDescription", str(exif.get("ImageDescription", ""))))
        parts = [
            f"text: {part}"
            for name, text in texts
            for part in descriptions.unknown_parts(f"{name.replace(':', '.')}: {text.strip()}")
        ]
        parts += [f"eXIf: {name}" for name in unknown_names(exif, EXIF_KEYS)]
        kind = MODES.get(image.mode)
        if kind is None or max(rows, columns) > EDGE:
            raise Refused(
                f"{file}: expected grey values of at most {EDGE} x {EDGE} pixels, got {rows} x "
                f"{columns} of the type {image.mode}"
            )
        head = Header((rows, columns), np.dtype(kind), 1, frozenset([2.0**bits - 1]))
        stated = {
            name: f"{exif[name]:g}" if isinstance(exif[name], float) else str(exif[name])
            for name in EXIF_BEAM
            if name in exif
        }
        if (time := exif.get("ExposureTime")) is not None:
            stated["ExposureTime"] = descriptions.milliseconds(file, float(time), "s")
        head = head._replace(stated={name: [text] for name, text in stated.items()})
        return head._replace(unknown=unknown_names([*chunks, *parts], PNG_KEYS))


def _exif(image: Any) -> dict[str, Any]:
    """The entries of EXIF by their names as tags of TIFF; ratios as numbers."""
    from PIL.TiffImagePlugin import IFDRational
    from tifffile import TIFF

    exif = image.getexif()
    return {
        TIFF.TAGS.get(tag, f"tag {tag}"): float(v) if isinstance(v, IFDRational) else v
        for tag, v in {**exif, **exif.get_ifd(CAMERA)}.items()
    }


def png_pages(file: Path, first: int, last: int) -> Iterator[np.ndarray]:
    """The one image of a PNG; raises Refused if it is cut short."""
    _check_rows(file)
    with _png(file) as image:
        yield np.asarray(image).astype(MODES[image.mode], copy=False)


def _check_rows(file: Path) -> None:
    """Raise for a truncated grey PNG: Pillow leaves missing rows zero."""
    data = file.read_bytes()
    columns, rows, bits, interlaced = struct.unpack_from(">IIB3xB", data, 16)
    sizes = [
        (len(range(y, rows, down)), len(range(x, columns, right)))
        for x, y, right, down in (INTERLACED if interlaced else PLAIN)
    ]
    needed = sum(m * (1 + (n * bits + 7) // 8) for m, n in sizes if n)  # a byte before each row
    stream, got = zlib.decompressobj(), 0
    for name, part in _chunks(file):
        if name == "IDAT" and got < needed:
            got += len(stream.decompress(data[part], needed - got))
    if got < needed:
        raise Refused(f"{file}: expected {needed} bytes of {rows} x {columns} pixels, got {got}")


def _chunks(file: Path) -> Iterator[tuple[str, slice]]:
    """Names of the chunks of a PNG, and the bytes of their contents."""
    with file.open("rb") as raw:
        raw.seek(8)
        while len(head := raw.read(8)) == 8:
            size, name = struct.unpack(">I4s", head)
            yield name.decode("latin-1"), slice(raw.tell(), raw.tell() + size)
            raw.seek(size + 4, 1)


@contextmanager
def _png(file: Path) -> Iterator[Any]:
    from PIL import Image as Pillow

    with Pillow.open(file, formats=["PNG"]) as image:
        yield image
