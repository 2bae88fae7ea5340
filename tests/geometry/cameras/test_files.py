import json

import pytest
import torch

from mvrecon.core.parts import CAMERAS
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.cameras.files import from_file, save
from tests.geometry.cameras.rigs import OPTIONS, random_cameras, same


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.json"
    save(random_cameras(), path)
    return path


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_a_rig_round_trips_exactly(name, tmp_path):
    cameras = CAMERAS.build(name, **OPTIONS[name])
    save(cameras, tmp_path / "rig.json")
    back = from_file(tmp_path / "rig.json")
    assert same(cameras, back, 0)
    assert all(torch.equal(getattr(cameras, vector), getattr(back, vector)) for vector in VECTORS)


def test_the_file_is_plain_json_with_one_line_per_camera(rig):
    record = json.loads(rig.read_text())
    assert (record["unit"], record["shape"], len(record["cameras"])) == ("mm", [7, 9], 5)
    assert sum('"source"' in line for line in rig.read_text().splitlines()) == 5


def test_writing_is_all_or_nothing(rig, monkeypatch):
    """A failed write keeps the previous camera file and leaves no other file."""
    before = rig.read_text()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save(random_cameras(seed=1), rig)
    assert rig.read_text() == before and list(rig.parent.iterdir()) == [rig]


def test_a_missing_file_is_named(tmp_path):
    """A missing camera file raises an error with its name and the expected format."""
    with pytest.raises(FileNotFoundError, match="none.json: no such file; expected JSON"):
        from_file(tmp_path / "none.json")


@pytest.mark.parametrize("text", ["", "{", "not json", b"\xff\xfe\x00binary"])
def test_files_that_are_not_json_are_refused(text, tmp_path):
    """A camera file that is empty or not JSON is refused by name."""
    path = tmp_path / "bad.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match="bad.json is truncated or not JSON"):
        from_file(path)


def test_a_truncated_file_is_refused_wherever_it_ends(rig):
    """A camera file that is cut short is refused, wherever it ends."""
    text = rig.read_text().rstrip()
    for length in range(0, len(text), 97):
        rig.write_text(text[:length])
        with pytest.raises(ValueError, match="truncated or not JSON"):
            from_file(rig)


def changed(record, **changes):
    return {**record, **changes}


def with_camera(record, **changes):
    first, *rest = record["cameras"]
    return {**record, "cameras": [{**first, **changes}, *rest]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: [1, 2], "expected the format 'mvrecon.cameras', got 'list'"),
        (lambda r: {"poses": []}, "expected the format 'mvrecon.cameras', got None"),
        (lambda r: changed(r, version=2), "expected the version 1, got 2"),
        (lambda r: changed(r, unit="cm"), "expected the unit 'mm', got 'cm'"),
        (lambda r: changed(r, shape=[7]), r"\(rows, columns\)"),
        (lambda r: changed(r, shape=[7, -9]), "both positive integers"),
        (lambda r: changed(r, shape="7x9"), "'shape' as .* got '7x9'"),
        (lambda r: changed(r, parallel="no"), "'parallel' as true or false, got 'no'"),
        (lambda r: changed(r, extent="all"), "Unknown extent 'all'"),
        (lambda r: changed(r, extent="behind"), "left-handed"),
        (lambda r: changed(r, cameras=[]), r"at least one, got \[\]"),
        (lambda r: changed(r, cameras=[3]), "'source' of camera 0 as three finite mm, got None"),
        (
            lambda r: with_camera(r, u=[1.0, 2.0]),
            r"'u' of camera 0 as three finite mm, got \[1.0, 2.0\]",
        ),
        (lambda r: with_camera(r, v=[1.0, "2", 3.0]), "'v' of camera 0 as three finite mm"),
        (
            lambda r: with_camera(r, origin=[1.0, float("nan"), 3.0]),
            "'origin' of camera 0 as three finite mm, got .*nan",
        ),
        (
            lambda r: with_camera(r, source=None),
            "'source' of camera 0 as three finite mm, got None",
        ),
        (lambda r: with_camera(r, u=[0.0, 0.0, 0.0]), "must not be flat"),
        (lambda r: changed(r, world="LPS"), "entries of the layout alone, got 'world'"),
        (lambda r: with_camera(r, scale=2), "entries of the layout alone, got 'scale'"),
    ],
)
def test_files_with_wrong_entries_are_refused(change, message, rig):
    """A camera file with wrong entries is refused, with the entry and the expected value."""
    rig.write_text(json.dumps(change(json.loads(rig.read_text()))))
    with pytest.raises(ValueError, match=f"rig.json is not valid: .*{message}"):
        from_file(rig)
