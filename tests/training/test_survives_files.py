"""Checkpoint files: whole, checked when they are read, and the one before at hand."""

import errno
import os
import random
import re
import signal
import zipfile

import numpy as np
import pytest
import torch

from mvrecon.core.files.atomic import claimed, written_whole
from mvrecon.core.files.checks import Refused
from mvrecon.training import checkpoints
from mvrecon.training.resume import RandomNumbers
from tests.faults.fault_injection import counted, signalled

SEED = int(os.environ.get("MVRECON_SEED", "0"))


def checkpoint(step):
    return {
        "global_step": step,
        "state_dict": {"w": torch.full((64,), float(step))},
        "note": [1, (2.0, "x"), None],
    }


@pytest.fixture
def last(tmp_path):
    path = tmp_path / "last.ckpt"
    for step in (3, 6):
        checkpoints.write(path, checkpoint(step))
    return path


def step(path):
    return checkpoints.read_newest(path)["global_step"]


def test_a_written_checkpoint_is_read_and_the_previous_one_is_kept(last):
    assert step(last) == 6 and step(checkpoints.previous(last)) == 3
    assert {path.name for path in last.parent.iterdir()} == {"last.ckpt", "last.previous.ckpt"}
    assert checkpoints.read(last)["note"] == [1, (2.0, "x"), None]


def test_other_programs_read_the_file_as_a_torch_checkpoint(last):
    assert torch.equal(torch.load(last)["state_dict"]["w"], torch.full((64,), 6.0))
    with zipfile.ZipFile(last) as archive:
        assert archive.testzip() is None and archive.comment.startswith(checkpoints.DIGEST_TAG)
    plain = last.with_name("plain.ckpt")
    torch.save(checkpoint(9), plain)
    assert step(plain) == 9, "nor does a checkpoint need a checksum"


def test_any_flipped_bit_falls_back_to_the_previous_file_and_both_are_named(last):
    """One flipped bit in a checkpoint leads to the checkpoint before it, and both are named."""
    whole, rng = last.read_bytes(), random.Random(SEED)
    for place in [
        0,
        21,
        *rng.sample(range(len(whole) - checkpoints.COMMENT_BYTES), 60),
        len(whole) - 1,
        len(whole) - 20,
    ]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.randrange(8)
        last.write_bytes(damaged)
        with pytest.warns(RuntimeWarning, match=r"last\.ckpt: is damaged.*last\.previous\.ckpt"):
            assert step(last) == 3, f"seed {SEED}, byte {place}"


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.99, 1.0])
def test_a_truncated_file_falls_back_to_the_previous_one(last, kept):
    """A checkpoint that is cut short leads to the one before it."""
    whole = last.read_bytes()
    last.write_bytes(whole[: min(int(kept * len(whole)), len(whole) - 1)])
    with pytest.warns(
        RuntimeWarning, match=r"last\.ckpt: is (damaged|cut short).*last\.previous\.ckpt"
    ):
        assert step(last) == 3


def test_a_kill_between_the_two_renames_keeps_the_previous_file(last):
    """A kill between the two renames of a checkpoint keeps the previous one."""
    last.unlink()
    with pytest.warns(RuntimeWarning, match=r"last\.ckpt is missing.*last\.previous\.ckpt"):
        assert step(last) == 3
    checkpoints.previous(last).unlink()
    with pytest.raises(FileNotFoundError):
        step(last)


def test_two_damaged_files_are_an_error_not_a_fresh_start(last):
    """Two damaged checkpoints are an error, not a fresh start."""
    for path in (last, checkpoints.previous(last)):
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    with (
        pytest.warns(RuntimeWarning),
        pytest.raises(checkpoints.DamagedCheckpoint, match=r"last\.previous\.ckpt: is damaged"),
    ):
        step(last)
    checkpoints.previous(last).write_bytes(checkpoints.previous(last).read_bytes()[:-1])
    with (
        pytest.warns(RuntimeWarning),
        pytest.raises(Refused, match=r"last\.previous\.ckpt: is cut"),
    ):
        step(last)


@pytest.mark.parametrize(
    ("owner", "name"), [("os", "fsync"), ("pathlib.Path", "write_bytes"), ("torch", "save")]
)
@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), MemoryError("no memory left")]
)
def test_write_errors_are_reported_and_keep_both_files(last, monkeypatch, owner, name, error):
    """A full disk or too little memory while a checkpoint is written is an error, and both older
    ones stay.
    """

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(f"{owner}.{name}", fail)
    with pytest.raises(type(error), match=str(error.args[-1])):
        checkpoints.write(last, checkpoint(9))
    monkeypatch.undo()
    assert step(last) == 6 and step(checkpoints.previous(last)) == 3
    assert len(list(last.parent.iterdir())) == 2


def test_non_finite_weights_never_replace_finite_ones(last):
    """Weights that are not finite never replace good ones on the disk."""
    bad = checkpoint(9)
    bad["state_dict"]["w"][3] = float("nan")
    with pytest.raises(
        FloatingPointError,
        match=r"last\.ckpt is not written: 1 weights are not finite, w among them",
    ):
        checkpoints.write(last, bad)
    assert step(last) == 6


def test_a_file_is_written_atomically(tmp_path):
    """A file is written whole or not at all."""
    path = tmp_path / "results.json"
    path.write_text("before")
    with pytest.raises(RuntimeError, match="power cut"), written_whole(path) as part:
        part.write_text("half")
        raise RuntimeError("power cut")
    assert path.read_text() == "before" and [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_a_claim_removes_files_of_a_killed_writer(tmp_path):
    """What a killed writer left half done is cleared away by the next one."""
    left = tmp_path / "checkpoints" / ".last.ckpt.123.part"
    left.parent.mkdir()
    left.write_text("half")
    with claimed(tmp_path):
        assert not left.exists() and str(os.getpid()) in (tmp_path / ".lock").read_text()


def test_a_full_disk_that_names_no_file_names_the_folder(tmp_path):
    """TensorBoard's writer raises the error of its thread, which names no file. Tried: trainings on
    disks of 40, 100 and 200 KiB, each resumed to the bits of an undisturbed one.
    """
    full = OSError(errno.ENOSPC, "No space left on device")
    full.add_note("the last checkpoint")
    with pytest.raises(OSError, match=re.escape(f"device: '{tmp_path}'")) as raised:
        with claimed(tmp_path):
            raise full
    assert raised.value.__notes__ == ["the last checkpoint"]
    with pytest.raises(OSError, match="Input/output error$"), claimed(tmp_path):
        raise OSError(errno.EIO, "Input/output error")  # as of an input, which may be elsewhere


def test_global_random_numbers_continue_after_resuming():
    def drawn():
        return random.random(), np.random.standard_normal(), torch.rand(3).tolist()

    drawn()
    state, first = RandomNumbers().state_dict(), drawn()
    again = RandomNumbers()
    again.load_state_dict(state)
    assert drawn() != first, "until training starts, nothing is put back"
    again.on_train_start(None, None)
    assert drawn() == first


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process is forked and killed as on POSIX")
@pytest.mark.parametrize(
    ("name", "n"), [("fsync", 1), ("fsync", 2), ("replace", 1), ("replace", 2)]
)
def test_a_kill_at_any_flush_or_rename_leaves_a_complete_checkpoint(last, name, n):
    """A kill at any flush or rename while a checkpoint is written leaves the complete old or new
    one.
    """
    child = os.fork()
    if not child:
        try:
            counted(os, name, n, signalled(signal.SIGKILL))
            checkpoints.write(last, checkpoint(9))
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert step(last) in (6, 9)
    checkpoints.write(last, checkpoint(12))
    assert step(last) == 12


def test_a_file_size_limit_keeps_the_last_checkpoint(last):
    """A checkpoint that the kernel does not let grow is an error; the last one stays and nothing is
    left half done.
    """
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            checkpoints.write(last, checkpoint(9))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert step(last) == 6 and len(list(last.parent.iterdir())) == 2


def test_a_folder_that_is_a_file_is_an_error(last):
    """A checkpoint in a folder that is a file is an error; that file stays as it was."""
    with pytest.raises(OSError, match=r"last\.ckpt"):
        checkpoints.write(last / "below.ckpt", checkpoint(9))
    assert step(last) == 6 and len(list(last.parent.iterdir())) == 2
