"""Files that say what is not so: volume files (HDF5) and NIfTI whose declarations a reader must not
believe.
"""

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Change = Callable[[h5py.File], object]


def instead(name: str, **made: Any) -> Change:
    """Puts another dataset in the place of one; options as of `h5py.Group.create_dataset`."""

    def change(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **made)

    return change


def linked(kind: str) -> Change:
    """Puts a way to another file, or to another dataset, in the place of `ct`: virtual, raw,
    external or soft.
    """

    def change(file: h5py.File) -> None:
        dataset: Any = file["ct"]
        shape = dataset.shape
        del file["ct"]
        if kind == "virtual":
            layout = h5py.VirtualLayout(shape, "i2")
            layout[:] = h5py.VirtualSource("other.h5", "ct", shape=shape)
            file.create_virtual_dataset("ct", layout)
        elif kind == "raw":
            file.create_dataset("ct", shape, "i2", external=[("other.raw", 0, h5py.h5f.UNLIMITED)])
        else:
            file["ct"] = (
                h5py.ExternalLink("other.h5", "ct")
                if kind == "external"
                else h5py.SoftLink("/spacing")
            )

    return change


LINKS = ("external", "soft", "virtual", "raw")
HUGE = {"shape": (2, 2**14, 2**14, 2**14), "dtype": "i2"}
#: What is done to a file of two volumes, and what the refusal says.
DECLARED: dict[str, tuple[Change, str]] = {
    "a huge contiguous shape": (instead("ct", **HUGE), "'/ct' declares"),
    "a huge chunked shape": (
        instead("ct", **HUGE, chunks=(1, 64, 64, 64), compression="gzip"),
        "'/ct' declares",
    ),
    "more than 2^63 bytes": (
        instead(
            "ct",
            shape=(2, 2**20, 2**20, 2**20),
            dtype="f8",
            chunks=(1, 8, 8, 8),
            compression="gzip",
        ),
        "'/ct' declares",
    ),
    "too few bytes": (
        instead("ct", shape=(2, 256, 256, 256), dtype="i2", chunks=(1, 256, 256, 256)),
        "'/ct' declares",
    ),
    "a plugin's filter": (
        instead("ct", shape=(2, 4, 4, 4), dtype="i2", chunks=(1, 4, 4, 4), compression="lzf"),
        "has the filters .*expected gzip",
    ),
    "an object": (instead("ct", shape=(2, 4, 4, 4), dtype=h5py.vlen_dtype("i2")), "ct object"),
    "references": (instead("ct", shape=(2, 4, 4, 4), dtype=h5py.ref_dtype), "ct object"),
    "a compound": (
        instead("ct", shape=(2, 4, 4, 4), dtype=np.dtype([("a", "i2")])),
        "ct .*expected numbers",
    ),
    "an empty space": (instead("ct", data=h5py.Empty("i2")), "'/ct' is empty"),
    "a named type": (
        lambda f: (f.pop("ct"), f.__setitem__("ct", np.dtype("i2"))),
        "is a link, a group or stored",
    ),
    "infinite spacing": (instead("spacing", data=np.full((2, 3), np.inf)), "expected positive mm"),
    "tiny spacing": (instead("spacing", data=np.full((2, 3), 1e-300)), "expected positive mm"),
    "many spacings": (
        instead("spacing", shape=(2**40, 3), dtype="f8", chunks=(8, 3)),
        "'/spacing' declares",
    ),
    "attributes of numbers": (
        lambda f: f.attrs.update(units=np.arange(1000)),
        "attribute 'units' is int64",
    ),
    "many attributes": (
        lambda f: f.attrs.update(axes=["z", "y", "x"]),
        r"attribute 'axes' is object \(3,\)",
    ),
    "bytes that are no text": (
        lambda f: f.attrs.create("axes", b"\xff\xfe\xff", dtype="S3"),
        "UnicodeDecodeError",
    ),
}


def nifti(path: Path, tail: bytes = b"", **header: Any) -> Path:
    """A NIfTI file of 4 x 4 x 4 integers whose header says what it likes, and what follows it."""
    import nibabel

    image = nibabel.Nifti1Image(np.zeros((4, 4, 4), "i2"), np.eye(4))
    for key, value in header.items():
        image.header[key] = value
    raw = image.header.binaryblock[:344] + b"n+1\0" + bytes(4) + tail
    path.write_bytes(gzip.compress(raw) if path.suffix == ".gz" else raw)
    return path


DIMS = [3, 32767, 32767, 32767, 1, 1, 1, 1]
#: What a NIfTI header says, and what the refusal says.
HEADERS: dict[str, tuple[dict[str, Any], str]] = {
    "a huge shape": ({"dim": DIMS, "vox_offset": 352}, "declares"),
    "no voxels": ({"dim": [3, 0, 4, 4, 1, 1, 1, 1], "vox_offset": 352}, "shape"),
    "negative voxels": ({"dim": [3, -4, 4, 4, 1, 1, 1, 1], "vox_offset": 352}, "shape"),
    "data far away": ({"vox_offset": 1e30}, "declares"),
    "data nowhere": ({"vox_offset": np.nan}, "(cannot be read|expected vox_offset)"),
    "colours": ({"datatype": 128, "bitpix": 24, "vox_offset": 352}, "shape"),
    "complex values": ({"datatype": 32, "bitpix": 64, "vox_offset": 352}, "shape"),
    "no such type": ({"datatype": 7777, "vox_offset": 352}, "(cannot be read|unknown datatype)"),
    "no affine": ({"sform_code": 1, "srow_x": [np.nan] * 4, "vox_offset": 352}, "finite"),
    "voxels of a light year": (
        {
            "sform_code": 1,
            "vox_offset": 352,
            **{f"srow_{a}": row for a, row in zip("xyz", 1e19 * np.eye(4), strict=False)},
        },
        "voxels of",
    ),
}
