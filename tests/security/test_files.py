"""Malicious files are refused, with their name, in little time and memory."""

import json
import re
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest

from mvrecon.core import machine as memory
from mvrecon.core.files.checks import Refused, plain_name, text_of
from mvrecon.core.parts import CAMERAS
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from mvrecon.data.volume_files import read_volume
from mvrecon.geometry.cameras.files import from_file, save
from tests.data.conftest import RIG, stored
from tests.faults.damage import DECLARED, HEADERS, instead, nifti


def refused(read: Callable[[], object], message: str, megabytes: float = 64) -> None:
    """Reading raises, and takes less than `megabytes` (2^20 bytes)."""
    before = memory.peak() or 0
    tracemalloc.start()
    try:
        with pytest.raises(Refused, match=message):
            read()
        traced = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert max(traced, (memory.peak() or 0) - before) < megabytes * 2**20


def volume_file(path: Path, change: Callable[[h5py.File], object]) -> VolumeFile:
    write_volumes(path, stored(2))
    with h5py.File(path, "r+") as file:
        change(file)
    return VolumeFile(path)


@pytest.mark.parametrize("name", DECLARED)
def test_a_volume_file_allocates_no_more_than_it_contains(name: str, tmp_path: Path):
    """An HDF5 file that declares more than it holds, or leads to other files, is refused within 64
    MB.
    """
    change, message = DECLARED[name]
    refused(lambda: len(volume_file(tmp_path / "evil.h5", change)), rf"(?s)evil\.h5: .*{message}")


def test_an_unwritten_volume_is_refused_instead_of_zeros(tmp_path: Path):
    """A volume that was never written is refused instead of read as zeros."""
    made = {
        "shape": (2, 20, 30, 30),
        "dtype": "i2",
        "chunks": (1, 20, 30, 30),
        "compression": "gzip",
    }
    file = volume_file(tmp_path / "a.h5", instead("ct", **made))
    refused(lambda: file.read(0), r"a\.h5: '/ct' has 0 bytes for the chunk")


def bomb(file: h5py.File) -> None:
    """A chunk whose stream unfolds to 256 MiB in place of 36 kB."""
    packed = zlib.compressobj(1)
    raw = b"".join(packed.compress(bytes(2**20)) for _ in range(2**8)) + packed.flush()
    file["ct"].id.write_direct_chunk((0, 0, 0, 0), raw)


def test_a_chunk_cannot_expand_beyond_its_declared_size(tmp_path: Path):
    """A chunk of an HDF5 file that unfolds to more than it declares is refused, and the other
    volumes are read.
    """
    file = volume_file(tmp_path / "bomb.h5", bomb)
    refused(
        lambda: file.read(0), r"bomb\.h5: has|bomb\.h5: .*(unfolds to more|bytes for the chunk)"
    )
    assert file.read(1).name == "pt_1"


def test_a_chunk_of_allowed_size_cannot_expand_beyond_it_either(tmp_path: Path):
    noise = np.random.default_rng(0).integers(-1000, 1000, (20, 30, 30)).astype("i2")
    path = tmp_path / "bomb.h5"
    write_volumes(path, [Stored("a", noise, (1.0, 1.0, 1.0))])
    raw = zlib.compress(bytes(2**25), 9)  # 32 MiB in 32 kB, as many as the noise takes
    with h5py.File(path, "r+") as file:
        assert len(raw) < noise.nbytes
        file["ct"].id.write_direct_chunk((0, 0, 0, 0), raw)
    refused(
        lambda: VolumeFile(path).read(0),
        r"bomb\.h5: a chunk of \d+ bytes unfolds to more than",
        megabytes=16,
    )


@pytest.mark.parametrize(
    "name", ["../../evil", "/etc/evil", "..", "a\\b", "c:evil", "a\0b", "a\nb", "", "x" * 300]
)
def test_a_volumes_name_is_never_used_as_a_path(name: str, tmp_path: Path):
    """A volume's name never leads to another folder."""
    with pytest.raises(Refused, match="has the name"):
        plain_name(name, "a.h5")
    with pytest.raises((Refused, ValueError)):
        write_volumes(tmp_path / "w.h5", [Stored(name, np.zeros((2, 2, 2), "i2"), (1.0, 1.0, 1.0))])
    assert not (tmp_path / "w.h5").exists()
    if "\0" not in name:
        file = volume_file(
            tmp_path / "r.h5",
            instead("id", data=[name, "b"], dtype=h5py.string_dtype("utf-8", 400)),
        )
        refused(lambda: file.read(0), r"r\.h5: has the name")


def legacy(path: Path, damage: Callable[[bytearray], None]) -> VolumeFile:
    """A file whose texts have no fixed length, as others write them."""
    text = h5py.string_dtype()
    volume_file(path.with_name("ours.h5"), lambda file: None)
    with h5py.File(path.with_name("ours.h5")) as ours, h5py.File(path, "w") as raw:
        for name in ("ct", "spacing"):
            ours.copy(name, raw)
        raw.create_dataset("id", data=["pt_0", "pt_1"], dtype=text)
        raw.attrs.update(units="HU", axes="z, y, x")
    contents = bytearray(path.read_bytes())
    damage(contents)
    path.write_bytes(contents)
    return VolumeFile(path)


def test_variable_length_texts_are_read(tmp_path: Path):
    file = legacy(tmp_path / "a.h5", lambda raw: None)
    assert [file.read(k).name for k in range(2)] == ["pt_0", "pt_1"]


def endless(raw: bytearray) -> None:
    """Every object of the heap of texts becomes a hole of no size: libhdf5 2.0 walks it for
    ever.
    """
    heap = raw.index(b"GCOL\x01")
    raw[heap + 16 : heap + 32] = bytes(16)


def gigantic(raw: bytearray) -> None:
    """A text of nearly 4 GiB: libhdf5 2.0 makes room for it before it looks for it."""
    heaps = [found.start() for found in re.finditer(rb"GCOL\x01", raw)]
    references = [
        raw.find(struct.pack("<IQ", length, heap)) for heap in heaps for length in (4, 7, 8)
    ]
    for place in (place for place in references if place >= 0):
        raw[place : place + 4] = b"\xf0\xff\xff\xff"


@pytest.mark.parametrize("damage", [endless, gigantic])
def test_malformed_texts_accepted_by_libhdf5_do_no_harm(damage, tmp_path: Path):
    """Damaged texts of an HDF5 file end in an error, not in endless work or gigabytes."""
    file = legacy(tmp_path / "evil.h5", damage)
    refused(lambda: len(file), r"evil\.h5: cannot be opened .*its texts cannot be read")


@pytest.mark.pairwise(name=HEADERS, suffix=[".nii", ".nii.gz"])
def test_a_nifti_header_is_not_trusted(name: str, suffix: str, tmp_path: Path):
    """A NIfTI header that declares what its file does not hold is refused."""
    header, message = HEADERS[name]
    path = nifti(tmp_path / f"evil{suffix}", bytes(4 * 4 * 4 * 2), **header)
    refused(lambda: read_volume(path), rf"(?s)evil\{suffix}.*{message}")


def test_a_gzip_bomb_is_refused(tmp_path: Path):
    """A packed NIfTI file that declares gigabytes and holds little is refused within 64 MB."""
    path = nifti(
        tmp_path / "bomb.nii.gz",
        bytes(2**26),
        dim=[3, 1024, 1024, 1024, 1, 1, 1, 1],
        vox_offset=352,
    )
    refused(lambda: read_volume(path), r"bomb\.nii\.gz: cannot be read .*declares")


def test_extensions_of_a_nifti_header_are_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    image = nibabel.Nifti1Image(np.zeros((4, 4, 4), "i2"), np.eye(4))
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"x" * 64))
    nibabel.save(image, tmp_path / "a.nii")
    monkeypatch.setattr(
        nibabel.nifti1.Nifti1Extensions, "from_fileobj", lambda *_: pytest.fail("was parsed")
    )
    assert read_volume(tmp_path / "a.nii")[1].shape == (4, 4, 4)


def rig(path: Path) -> dict:
    save(CAMERAS.from_config(RIG), path)
    return json.loads(path.read_text())


NUMBERS = [
    "NaN",
    "Infinity",
    "-Infinity",
    "1e999",
    "1" + "0" * 400,
    "1e300",
    '"1"',
    "null",
    "true",
    "[1]",
    "{}",
]


@pytest.mark.pairwise(1, vector=["source", "origin", "u", "v"], number=NUMBERS)
def test_non_finite_camera_parameters_are_refused(number: str, vector: str, tmp_path: Path):
    """A camera file with a number that is not finite is refused."""
    record = rig(tmp_path / "evil.json")
    record["cameras"][1][vector][2] = "HERE"
    (tmp_path / "evil.json").write_text(json.dumps(record).replace('"HERE"', number))
    refused(lambda: from_file(tmp_path / "evil.json"), r"evil\.json is not valid")


TEXTS = {
    "digits without end": (b"1" * 10_000, "truncated or not JSON"),
    "brackets without end": (b"[" * 200_000, "truncated or not JSON"),
    "not UTF-8": (b'{"format": "\xff\xfe"}', "truncated or not JSON"),
    "zeros": (bytes(1000), "truncated or not JSON"),
    "a list of lists": (b"[" + b"[]," * 10_000 + b"[]]", "not valid"),
    "a long word": (b'{"format": "' + b"x" * 100_000 + b'"}', "not valid"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_an_invalid_camera_file_is_refused_with_a_short_message(name: str, tmp_path: Path):
    """A camera file that is no camera file is refused in less than 1000 characters, with its
    name.
    """
    raw, message = TEXTS[name]
    (tmp_path / "evil.json").write_bytes(raw)
    with pytest.raises(ValueError, match=message) as error:
        from_file(tmp_path / "evil.json")
    assert "evil.json" in str(error.value) and len(str(error.value)) < 1000


@pytest.mark.parametrize("shape", [[10**9, 10**9], [2**63, 1], [10**400, 1], [True, 7], [7.0, 9]])
def test_a_detector_with_too_many_pixels_is_refused(shape: list, tmp_path: Path):
    """A camera file with more pixels than can be is refused."""
    record = {**rig(tmp_path / "evil.json"), "shape": shape}
    (tmp_path / "evil.json").write_text(json.dumps(record))
    refused(lambda: from_file(tmp_path / "evil.json"), "'shape' as")


def test_a_text_file_is_read_up_to_a_limit(tmp_path: Path):
    """A text file of a terabyte is refused without reading it."""
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: a terabyte on no disk
    refused(lambda: text_of(path), r"large\.json: is larger than 16777216 bytes")
    with pytest.raises(ValueError, match="larger than"):
        from_file(path)
