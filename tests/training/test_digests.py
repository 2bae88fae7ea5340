"""A run knows its rig and its data by digest, and refuses others."""

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import mvrecon.apps.eval
import mvrecon.apps.train
from mvrecon.core.files.checks import Refused
from mvrecon.core.parts import CAMERAS
from mvrecon.data import digests
from mvrecon.geometry.cameras import files
from mvrecon.training import checkpoints, run_folder, trained
from tests.training.lives import METHOD
from tests.training.runs import RIG, call, rig_file


def test_a_run_stores_its_rig_and_the_digests_of_rig_and_data(run):
    """The run folder keeps the rig, number for number, and the checkpoint has its digest and the
    training cases.
    """
    folder, options = run
    kept = files.from_file(folder / "rig.json")
    assert all(
        torch.equal(getattr(kept, v), getattr(CAMERAS.from_config(RIG), v)) for v in files.VECTORS
    )
    method = trained.load_checkpoint(checkpoints.finished(folder, METHOD))
    assert (
        method.digests
        == json.loads((folder / "digests.json").read_text())
        == {"rig": digests.of_rig(kept)}
    )
    assert method.cases == [f"ellipsoids-5-{k}" for k in range(10)]
    state = torch.load(checkpoints.finished(folder, METHOD))
    assert state["SceneData"]["cases"] == method.cases


@pytest.mark.parametrize("kept", ["folder", "checkpoint"])
def test_a_rig_that_has_changed_is_refused(run, kept, tmp_path, capsys):
    """A rig file that has changed since is an error of evaluation and of resumption, by folder and
    by checkpoint.
    """
    folder, _ = run
    path = Path(run_folder.read_settings(folder).camera["path"])
    expected, whole = digests.of_rig(files.from_file(path)), (folder / "digests.json").read_bytes()
    try:
        if kept == "checkpoint":
            (folder / "digests.json").unlink()
        rig_file(path.parent, shift=5.0)
        got = digests.of_rig(files.from_file(path))
        for app, options in (
            (mvrecon.apps.eval, [f"checkpoint={folder}", f"hydra.run.dir={tmp_path}/eval"]),
            (mvrecon.apps.train, [f"resume={folder}"]),
        ):
            assert call(app, *options) == 1
            assert (
                f"rig: got sha256 {got[:16]}, expected {expected[:16]}" in capsys.readouterr().err
            )
    finally:
        rig_file(path.parent)
        (folder / "digests.json").write_bytes(whole)
    assert call(mvrecon.apps.eval, f"checkpoint={folder}", f"hydra.run.dir={tmp_path}/again") == 0


def test_a_rig_digest_depends_on_every_field():
    """Each part of a camera record changes its digest; a millionth of a micrometre, which a
    processor may, does not.
    """
    rig = CAMERAS.from_config(RIG)
    others = [replace(rig, **{name: getattr(rig, name) * (1 + 1e-6)}) for name in files.VECTORS]
    others += [
        replace(rig, shape=(12, 13)),
        replace(rig, extent="ahead"),
        replace(rig, parallel=True),
    ]
    assert len({digests.of_rig(one) for one in (rig, *others)}) == 8
    assert digests.of_rig(replace(rig, source=rig.source + 1e-13)) == digests.of_rig(rig)


def test_a_file_digest_depends_on_its_contents(tmp_path):
    """A data file that changes at the same path is refused, and one that is only copied or touched
    is not.
    """
    path = tmp_path / "a.h5"
    path.write_bytes(b"first")
    scene = {
        "name": "mixture",
        "scenes": [{"name": "hdf5", "path": str(path)}, {"name": "ellipsoids"}],
    }
    assert list(digests.files_in(scene)) == [str(path)]
    before = {str(path): digests.of_file(path)}
    os.utime(path, (0, 0))
    digests.compare({str(path): digests.of_file(path)}, before, "run")
    path.write_bytes(b"other")
    with pytest.raises(
        Refused, match=r"according to run: .*a\.h5: got sha256 [0-9a-f]{16}, expected [0-9a-f]{16}"
    ):
        digests.compare({str(path): digests.of_file(path)}, before, "run")


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("ct.mhd", "ElementDataFile = values/ct ä.raw"),
        ("nul.mhd", "Comment = a\0b = c\nElementDataFile = values/ct ä.raw"),
        ("ct.vgi", "[file1]\nSize = 2 2 2\nName=values/ct ä.raw\r"),
        ("mu.hv", "!INTERFILE :=\n!name of data file := values/ct ä.raw\n!END OF INTERFILE :="),
    ],
)
def test_the_digest_of_a_header_depends_on_the_values_that_it_states(
    tmp_path, header, line, encoding
):
    """Of MetaImage, VGStudio and Interfile; not on other files beside it, nor of a file that
    holds its own values, whose bytes may look like lines.
    """
    path, values = tmp_path / header, tmp_path / "values" / "ct ä.raw"
    values.parent.mkdir()
    path.write_bytes(line.encode(encoding))
    values.write_bytes(b"first")
    before = digests.of_file(path)
    (tmp_path / "other.raw").write_bytes(b"new")
    assert digests.of_file(path) == before
    values.write_bytes(b"other")
    assert digests.of_file(path) != before
    path.write_bytes(b"\0" + line.encode(encoding).replace(b"\n", b"\n\0"))
    assert digests.of_file(path) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_digest_of_a_folder_depends_on_what_its_links_lead_to(tmp_path):
    """A folder of links to patients elsewhere, one of which leads back to it."""
    folder, patient = tmp_path / "patients", tmp_path / "archive" / "1"
    folder.mkdir()
    patient.mkdir(parents=True)
    (patient / "slice").write_bytes(b"first")
    (folder / "a").symlink_to(patient)
    (patient / "all").symlink_to(folder)
    before = digests.of_file(folder)
    (patient / "slice").write_bytes(b"other")
    assert digests.of_file(folder) != before
