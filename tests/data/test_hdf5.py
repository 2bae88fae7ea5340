"""Volume files: round trip, atomic writes, and rejected files."""

import multiprocessing
import pickle
from random import Random

import h5py
import numpy as np
import pytest

from mvrecon.core.files.atomic import written_whole
from mvrecon.data import hdf5, resample as slabs
from mvrecon.data.hdf5 import Stored, VolumeFile, write_volumes
from tests.data.conftest import SPACING, head, stored
from tests.faults.damage import LINKS, instead, linked


def test_files_round_trip(tmp_path):
    path = tmp_path / "deep" / "a.h5"
    labels = np.arange(20 * 30 * 30, dtype=np.uint8).reshape(20, 30, 30)
    volumes = [Stored(f"pt_ä{k}", head((k, 0, 0)), (3.0, 2.0, 1.0 + k), labels) for k in range(3)]
    assert write_volumes(path, iter(volumes), orientation="LPI", source="a test") == 3
    file = VolumeFile(path)
    assert len(file) == 3 and file.orientation == "LPI"
    for k in (2, 0, 1):
        found = file.read(k)
        assert found.name == f"pt_ä{k}" and found.spacing == (3.0, 2.0, 1.0 + k)
        assert found.ct.dtype == np.int16 and np.array_equal(found.ct, volumes[k].ct)
    with h5py.File(path) as raw:
        assert {key: value.decode() for key, value in raw.attrs.items()} == {
            **{"axes": "z, y, x", "units": "HU"},
            **{"orientation": "LPI", "source": "a test"},
        }
        assert np.array_equal(raw["label"][1], labels)


def test_a_crash_leaves_only_the_old_file(volume_file):
    before = volume_file.read_bytes()

    def breaking():
        yield stored(1)[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_volumes(volume_file, breaking())
    assert volume_file.read_bytes() == before
    assert [p.name for p in volume_file.parent.iterdir()] == [volume_file.name]


def test_the_new_file_replaces_the_old_one_only_at_the_end(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with written_whole(path) as part:
        part.write_text("new")
        assert path.read_text() == "old" and part.parent == path.parent
    assert path.read_text() == "new" and not part.exists()


def test_readers_see_the_complete_old_file_during_a_rewrite(tmp_path):
    """Readers of a volume file see its old edition whole until the new one is written whole."""
    path = tmp_path / "a.h5"

    def values(file):
        return {int(value) for k in range(len(file)) for value in np.unique(file.read(k).ct)}

    def edition(number):
        for k in range(3):
            assert not number or values(VolumeFile(path)) == {0}, "while the new one is written"
            yield Stored(f"pt_{k}", np.full((4, 6, 6), number, np.int16), SPACING)

    write_volumes(path, edition(0))
    opened = VolumeFile(path)
    assert values(opened) == {0}
    write_volumes(path, edition(1))
    assert values(opened) == {0} and values(VolumeFile(path)) == {1}


def test_inconsistent_volumes_are_refused(tmp_path):
    label = np.zeros((20, 30, 30), np.uint8)
    for second in (
        Stored("b", head(shape=(20, 30, 31)), SPACING),
        Stored("b", head(), SPACING, label),
    ):
        with pytest.raises(ValueError, match="volume 'b' has .* expected .* as the first"):
            write_volumes(tmp_path / "a.h5", [*stored(1), second])
    with pytest.raises(ValueError, match="at least one volume"):
        write_volumes(tmp_path / "a.h5", [])
    assert not list(tmp_path.iterdir())


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no\.h5: no such file; expected an mvrecon volume file: HDF5 with"
    ):
        len(VolumeFile(tmp_path / "no.h5"))


SPOILT = {
    "a tenth": lambda whole: whole[: len(whole) // 10],
    "half": lambda whole: whole[: len(whole) // 2],
    "all but a byte": lambda whole: whole[:-1],
    "nothing": lambda whole: b"",
    "zeros": lambda whole: bytes(4096),
    "text": lambda whole: b"hello",
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_truncated_or_invalid_volume_file_is_refused(volume_file, name):
    """A volume file that is cut short, empty, or no HDF5 file is refused with its name."""
    volume_file.write_bytes(SPOILT[name](volume_file.read_bytes()))
    with pytest.raises(
        ValueError,
        match=r"heads\.h5: (not an HDF5 file; e|cannot be opened .*cut short\? E)xpected",
    ):
        VolumeFile(volume_file).read(0)


def test_a_flipped_bit_never_changes_a_volume_silently(tmp_path):
    """A flipped bit in a volume's numbers is an error, or the volume is read as it was written."""
    rng, path = Random(0), tmp_path / "a.h5"
    noise = (
        np.random.default_rng(0).integers(-(2**15), 2**15, (20, 30, 30)).astype("i2")
    )  # packed, it does not shrink
    written = [*stored(1), Stored("noise", noise, SPACING)]
    write_volumes(path, written)
    whole = path.read_bytes()
    with h5py.File(path) as file:
        chunks = [file["ct"].id.get_chunk_info(k) for k in range(2)]
    for k in (0, 1) * 12:
        raw, place = bytearray(whole), chunks[k].byte_offset + rng.randrange(chunks[k].size)
        raw[place] ^= 1 << rng.randrange(8)
        path.write_bytes(raw)
        try:
            assert np.array_equal(VolumeFile(path).read(k).ct, written[k].ct), (
                f"volume {k}, byte {place}"
            )
        except ValueError as error:
            assert f"a.h5: volume {k} cannot be read" in str(error)


def test_damaged_bytes_are_an_error(volume_file):
    with h5py.File(volume_file) as file:
        chunk = file["ct"].id.get_chunk_info(3)
    with volume_file.open("r+b") as raw:
        raw.seek(chunk.byte_offset)
        raw.write(b"\xff" * chunk.size)
    file = VolumeFile(volume_file)
    assert file.read(2).name == "pt_2"
    with pytest.raises(ValueError, match="volume 3 cannot be read .*damaged"):
        file.read(3)


def rewritten(path, change):
    with h5py.File(path, "r+") as file:
        change(file)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("ct"), r"no dataset 'ct', only \['id', 'spacing'\]"),
        (instead("ct", data=np.zeros((7, 4, 4))), r"'ct': \(7, 4, 4\).*ct \[n d h w\]"),
        (instead("ct", shape=(7, 4, 4, 4), dtype="c8"), "ct complex64.*expected numbers"),
        (instead("ct", data=np.full((7, 1, 1, 1), b"a", "S3")), "expected numbers"),
        (instead("ct", data=1.0), r"'ct': \(\)"),
        (instead("spacing", data=np.ones((6, 3))), r"'spacing': \(6, 3\)"),
        (
            instead("spacing", data=np.diag([1.0, 1, 1, 0, 0, 0, 0])[:, :3]),
            r"volume 0 has the spacing \[1.0, 0.0, 0.0\]",
        ),
        (instead("spacing", data=np.full((7, 3), np.nan)), "expected positive mm"),
        (lambda f: f.attrs.update(axes="x, y, z"), "'axes': 'x, y, z'.*expected"),
        (lambda f: f.attrs.pop("units"), "'units': None"),
        (lambda f: f.attrs.update(units="cm"), "'units': 'cm'"),
        (instead("id", data=[b"a"]), r"'ct': \(7, .*'spacing': \(7, 3\), 'id': \(1,\)"),
    ],
)
def test_a_file_of_another_layout_is_refused_with_the_reason(volume_file, change, message):
    with pytest.raises(ValueError, match=rf"(?s)heads\.h5: .*{message}"):
        len(VolumeFile(rewritten(volume_file, change)))


@pytest.mark.parametrize("kind", LINKS)
def test_a_file_cannot_link_to_other_files(volume_file, kind):
    write_volumes(volume_file.with_name("other.h5"), stored(7))
    with pytest.raises(ValueError, match="'ct' is a link, a group or stored elsewhere"):
        VolumeFile(rewritten(volume_file, linked(kind))).read(0)


def first_voxels(file):
    return [int(file.read(k).ct.astype(int).sum()) for k in range(len(file))]


def test_an_open_file_goes_to_other_processes(volume_file):
    file = VolumeFile(volume_file)
    here = first_voxels(file)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map(first_voxels, [file, file]) == [here, here]
    assert pickle.loads(pickle.dumps(file))._open is None


def test_names_are_unique(volume_file):
    """A volume file in which two volumes have one name is refused, and none is written."""
    rewritten(volume_file, lambda file: file["id"].__setitem__(5, "pt_2"))
    with pytest.raises(
        ValueError,
        match=r"heads\.h5: has several volumes named \['pt_2'\]; expected every name",
    ):
        len(VolumeFile(volume_file))
    with pytest.raises(ValueError, match=r"several volumes named \['pt_0'\]"):
        write_volumes(volume_file.with_name("new.h5"), [*stored(2), *stored(1)])
    assert not volume_file.with_name("new.h5").exists()


def test_volumes_are_read_as_written_or_not_at_all(volume_file):
    """A volume file of mvrecon's in which one bit has flipped, anywhere, is refused or has the
    values written.
    """
    whole, rng = volume_file.read_bytes(), Random(2)

    def contents() -> list[tuple]:
        volumes = map(VolumeFile(volume_file).read, range(7))
        return [(v.name, v.spacing, v.ct.tobytes()) for v in volumes]

    written, refused = contents(), 0
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        volume_file.write_bytes(damaged)
        try:
            assert contents() == written
        except ValueError as error:
            refused += "heads.h5" in str(error)
    assert refused > 100


def test_slabs_equal_the_volume_for_any_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "CHUNK_BYTES", 4 * 30 * 30 * 2)  # four planes
    write_volumes(tmp_path / "a.h5", stored(2))
    monkeypatch.setattr(slabs, "SLAB_VOXELS", 6 * 30 * 30)
    file = VolumeFile(tmp_path / "a.h5")
    assert file.file["ct"].chunks == (1, 4, 30, 30)
    name, parts, spacing = file.slabs(1)
    assert (name, parts.shape, spacing) == ("pt_1", (20, 30, 30), SPACING)
    assert [(first, len(part)) for first, part in parts] == [(k, 4) for k in range(0, 20, 4)]
    assert np.array_equal(parts.whole().numpy(), stored(2)[1].ct) and np.array_equal(
        file.read(1).ct, stored(2)[1].ct
    )


def test_a_chunk_of_gigabytes_is_refused_immediately(tmp_path):
    """A volume in one chunk of over 256 MiB, which cannot be read in slabs, is refused before it is
    unpacked.
    """
    path = tmp_path / "large.h5"
    write_volumes(path, stored(1))
    large = {
        "shape": (1, 600, 512, 512),
        "dtype": "i2",
        "chunks": (1, 600, 512, 512),
        "compression": "gzip",
    }
    rewritten(path, instead("ct", **large))
    with path.open("ab") as file:
        file.write(bytes(2**20))  # as much as the zeros would take
    with pytest.raises(
        ValueError, match=r"large\.h5: '/ct' declares .*expected chunks of at most 268435456 bytes"
    ):
        len(VolumeFile(path))
