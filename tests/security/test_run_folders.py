"""An untrusted run folder: nothing outside it is written or removed, whatever it contains."""

import os
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from mvrecon.apps.config import compose
from mvrecon.apps.train import resumed, train
from mvrecon.core.files.atomic import claimed
from mvrecon.core.files.checks import Refused
from mvrecon.training import fit
from mvrecon.training.callbacks import Confined
from mvrecon.training.checkpoints import DurableCheckpoints, previous, remove
from mvrecon.training.settings import TrainSettings
from mvrecon.training.targets import instantiate
from tests.training.lives import OPTIONS

CALLBACKS, LOGGERS, OWN = (
    "lightning.pytorch.callbacks",
    "lightning.pytorch.loggers",
    "mvrecon.training",
)
NAMES = (
    "checkpoints",
    ".lock",
    "config.yaml",
    "versions.txt",
    "results.json",
    "metrics.csv",
    "review",
    "sirt",
)
PARTS = (".results.json.1.part", "events.out.tfevents.1.a.1.0", "review/planes.png", "a/b/c")


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """What the user has beside the run folder."""
    (tmp_path / "home" / "Documents").mkdir(parents=True)
    (tmp_path / "home" / "Documents" / "thesis.txt").write_text("years of work")
    return tmp_path / "home"


def contents(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def run_folder(path: Path, settings: dict) -> Path:
    path.mkdir()
    (path / "config.yaml").write_text(yaml.safe_dump(settings))
    return path


def test_a_resumed_run_removes_nothing_outside_its_folder(home: Path, tmp_path: Path):
    """`resume=` a folder whose checkpoints lead to the user's documents, with a method of that
    name: they stay.
    """
    settings = TrainSettings(**compose(*OPTIONS))
    settings.compare, settings.method = {"Documents": settings.method}, {"name": "backprojection"}
    folder = run_folder(tmp_path / "sent", vars(settings))
    (folder / "checkpoints").symlink_to(home)
    before = contents(home)
    with pytest.raises(PermissionError, match="sent holds checkpoints, a link"):
        resumed(str(folder), [])
    with pytest.raises(PermissionError, match="sent holds checkpoints, a link"):
        train(settings, folder)
    assert contents(home) == before


@pytest.mark.parametrize("name", [*NAMES, *PARTS])
def test_a_run_folder_with_a_link_in_it_is_refused(name: str, home: Path, tmp_path: Path):
    """A run folder that contains any link is refused before anything is written."""
    for target in (home / "Documents", home / "Documents" / "thesis.txt", home / "new"):
        folder = tmp_path / f"sent to {target.name}"
        link = folder / name
        link.parent.mkdir(parents=True)
        link.symlink_to(target)
        before = contents(home)
        with pytest.raises(
            PermissionError, match="a link, a pipe or a device; expected files and folders"
        ):
            with claimed(folder):
                pytest.fail("the folder must not be taken")
        assert contents(home) == before
        assert [
            path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()
        ] == []


def test_a_pipe_in_a_run_folder_is_refused(tmp_path: Path):
    """A named pipe in a run folder, which would block a reader forever, is refused."""
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises(PermissionError, match=r"holds \.lock"), claimed(tmp_path):
        pytest.fail("the folder must not be taken")


def test_a_run_folder_may_be_accessed_through_a_user_s_link(tmp_path: Path):
    """A link that the user made to a run folder works: only those inside are not followed."""
    folder = run_folder(tmp_path / "run", {"name": "a"})
    (tmp_path / "latest").symlink_to(folder)
    assert resumed(str(tmp_path / "latest"), []) == (TrainSettings(name="a"), folder.resolve())


def test_only_named_files_are_removed(tmp_path: Path):
    """A finished training removes its two last checkpoints by name, and their folder only if
    nothing is left in it.
    """
    last = tmp_path / "sirt" / "last.ckpt"
    last.parent.mkdir()
    for path in (last, previous(last), last.with_name("notes.txt")):
        path.touch()
    remove(last)
    assert [path.name for path in last.parent.iterdir()] == ["notes.txt"]
    last.with_name("notes.txt").unlink()
    remove(last)
    assert not last.parent.exists()


@pytest.mark.parametrize("label", ["../Documents", "/etc", "a/b", "..", "a\\b", ""])
def test_a_label_must_be_a_name(label: str):
    """The label of a compared method is a name and no path, or nothing is trained."""
    with pytest.raises(Refused, match="has the name"):
        TrainSettings(method={"name": "sirt"}, compare={label: {"name": "sirt"}}).methods()


def outside(home: Path) -> dict[str, dict]:
    """Callbacks and loggers that would write into the user's documents, or somewhere else."""
    documents = str(home / "Documents")
    ways = {
        "absolute": documents,
        "up": "../home/Documents",
        "of the user": "~/x",
        "by address": f"file://{documents}",
    }
    ways |= {
        "by a short address": f"file:{documents}",
        "by a chain": f"simplecache::{documents}",
        "memory": "memory://x",
    }
    kinds = {
        "a checkpoint": (f"{CALLBACKS}.ModelCheckpoint", "dirpath"),
        "a checkpoint's name": (f"{CALLBACKS}.ModelCheckpoint", "filename"),
        "an exception's": (f"{CALLBACKS}.OnExceptionCheckpoint", "dirpath"),
        "skipped batches": (
            "lightning.pytorch.callbacks.spike.SpikeDetection",
            "exclude_batches_path",
        ),
        "a board's name": (f"{LOGGERS}.TensorBoardLogger", "name"),
        "a board's version": (f"{LOGGERS}.TensorBoardLogger", "version"),
        "a board's sub-folder": (f"{LOGGERS}.TensorBoardLogger", "sub_dir"),
        "a board's events": (f"{LOGGERS}.TensorBoardLogger", "filename_suffix"),
        "a table's name": (f"{LOGGERS}.CSVLogger", "name"),
        "a table's version": (f"{LOGGERS}.CSVLogger", "version"),
    }
    return {
        f"{kind}, {way}": {"_target_": target, option: value}
        for kind, (target, option) in kinds.items()
        for way, value in ways.items()
    }


@pytest.mark.parametrize("name", sorted(outside(Path("home"))))
def test_callbacks_and_loggers_write_into_the_run_folder(name: str, home: Path, tmp_path: Path):
    """Whatever option of a callback or a logger leads out of the run folder is refused, and nothing
    is written.
    """
    node, before = outside(home)[name], contents(home)
    save = {"save_dir": str(tmp_path / "run")} if "loggers" in node["_target_"] else {}
    with pytest.raises(PermissionError, match="expected a place inside the run folder"):
        instantiate(node, tmp_path / "run", **save)
    assert contents(home) == before and not (tmp_path / "run").exists()


def test_paths_from_defaults_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A logger that would write into the current folder, because that is its default, is
    refused.
    """
    monkeypatch.setattr(CSVLogger, "log_dir", str(tmp_path))
    node = {"_target_": f"{LOGGERS}.CSVLogger"}
    with pytest.raises(PermissionError, match="log_dir of CSVLogger leads to"):
        instantiate(node, tmp_path / "run", save_dir=str(tmp_path / "run"))


@pytest.mark.parametrize(
    "name", ["resume.KeepLast", "resume.RandomNumbers", "callbacks.Clock", "callbacks.Confined"]
)
def test_built_in_callbacks_of_a_run_cannot_be_requested(name: str, tmp_path: Path):
    """The callbacks of every run, such as the one for its last checkpoint, cannot be requested."""
    with pytest.raises(
        PermissionError, match="not allowed; expected none that every run has already"
    ):
        instantiate({"_target_": f"{OWN}.{name}", "path": "x"}, tmp_path)


def test_inner_paths_are_relative_to_the_run_folder(tmp_path: Path):
    checkpoints = instantiate(
        {"_target_": f"{CALLBACKS}.ModelCheckpoint", "dirpath": "best"}, tmp_path
    )
    assert isinstance(checkpoints, ModelCheckpoint) and checkpoints.dirpath == str(
        tmp_path.resolve() / "best"
    )
    node = {
        "_target_": f"{LOGGERS}.TensorBoardLogger",
        "name": "mine",
        "version": "a",
        "sub_dir": "b",
    }
    board = instantiate(node, tmp_path, save_dir=str(tmp_path))
    assert isinstance(board, TensorBoardLogger) and board.log_dir == str(
        tmp_path / "mine" / "a" / "b"
    )


def test_checkpoints_are_kept_and_removed_inside_the_run_folder(home: Path, tmp_path: Path):
    """No checkpoint is written or removed outside the run folder, whatever paths an older one
    contains.
    """
    kept, thesis = DurableCheckpoints(tmp_path / "run"), home / "Documents" / "thesis.txt"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "out").symlink_to(home)
    for path in (
        thesis,
        tmp_path / "run/../home/Documents/thesis.txt",
        tmp_path / "run/out/Documents/thesis.txt",
    ):
        with pytest.raises(PermissionError, match="expected a place inside the run folder"):
            kept.save_checkpoint({"x": torch.zeros(1)}, path)
        with pytest.raises(PermissionError, match="expected a place inside the run folder"):
            kept.remove_checkpoint(path)
    assert thesis.read_text() == "years of work"


def test_a_checkpoint_cannot_set_an_outside_path_for_a_callback(home: Path, tmp_path: Path):
    """Training does not start from a checkpoint that makes a callback write elsewhere."""
    settings = TrainSettings(**compose(*OPTIONS))
    settings.callbacks = {
        "spikes": {"_target_": "lightning.pytorch.callbacks.spike.SpikeDetection"}
    }
    folder = tmp_path / "run"
    trainer = fit.build_trainer(settings, folder, settings.method["name"])
    spikes = next(
        callback for callback in trainer.callbacks if type(callback).__name__ == "SpikeDetection"
    )
    guards = [callback for callback in trainer.callbacks if isinstance(callback, Confined)]
    spikes.exclude_batches_path = str(home / "Documents" / "thesis.txt")
    with pytest.raises(PermissionError, match="exclude_batches_path of SpikeDetection leads to"):
        for guard in guards:
            guard.on_fit_start(trainer, None)
