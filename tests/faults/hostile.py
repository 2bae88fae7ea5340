"""What was made to harm: configs, experiments and pickles that would run something if they were
believed.

Each would leave a file, the sentinel, behind; where it is not there, nothing ran.
"""

import io
import os
import pickle
import zipfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch


class Payload:
    """Unpickling it runs a command."""

    def __init__(self, command: str):
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def targets(sentinel: Path) -> dict[str, dict[str, Any]]:
    """Nodes of a config that would make the sentinel if they were built; one unpickles
    `payload.ckpt` beside it.
    """
    touch = f"touch {sentinel}"
    pickled = sentinel.with_name("payload.ckpt")
    timer = {"_target_": "lightning.pytorch.callbacks.Timer"}
    call = "lightning.pytorch.cli.instantiate_class"
    load = "lightning.pytorch.LightningModule.load_from_checkpoint"
    return {
        "direct": {"_target_": "os.system", "command": touch},
        "builtin": {"_target_": "builtins.eval", "source": f"open({str(sentinel)!r}, 'w')"},
        "through a module's import": {
            "_target_": "lightning.pytorch.trainer.trainer.os.system",
            "command": touch,
        },
        "through another package": {"_target_": "logging.os.system", "command": touch},
        "a function that calls": {
            "_target_": call,
            "args": touch,
            "init": {"class_path": "os.system"},
        },
        "a function that writes": {
            "_target_": "mvrecon.training.run_folder.write_text",
            "path": str(sentinel),
            "text": "x",
        },
        "a method that unpickles": {
            "_target_": load,
            "checkpoint_path": str(pickled),
            "weights_only": False,
        },
        "a class of another kind": {
            "_target_": "lightning.pytorch.Trainer",
            "default_root_dir": str(sentinel),
        },
        "nested": {**timer, "duration": {"_target_": "os.system", "command": touch}},
        "nested in a list": {**timer, "duration": [{"_target_": "os.system", "command": touch}]},
        "partial": {**timer, "_partial_": True},
        "positional": {**timer, "_args_": [touch]},
        "not a name": {"_target_": ["os.system"], "command": touch},
    }


def experiments(sentinel: Path) -> dict[str, str]:
    """Experiments that tell Hydra itself what to do; each made the sentinel, or opened a way to,
    before the guard.
    """
    touch, call = f'"touch {sentinel}"', "lightning.pytorch.cli.instantiate_class"
    evil = f"{{_target_: {call}, args: {touch}, init: {{class_path: os.system}}}}"
    handler = f"{{class: {call}, args: {touch}, init: {{class_path: os.system}}}}"
    return {
        "a callback": f"hydra: {{callbacks: {{evil: {evil}}}}}",
        "a log handler": f"hydra: {{job_logging: {{handlers: {{file: {handler}}}}}}}",
        "a log file": f"hydra: {{job_logging: {{handlers: {{file: {{filename: {sentinel}}}}}}}}}",
        "a library's folder": "hydra: {job: {env_set: {HDF5_PLUGIN_PATH: .}}}",
        "a launcher": "hydra: {launcher: {_target_: os.system}}",
        "a folder": f"hydra: {{run: {{dir: {sentinel}}}}}",
        "another choice": "defaults: [override /hydra/job_logging: none]",
    }


def experiment(folder: Path, text: str, **files: str) -> list[str]:
    """An experiment in a folder that was fetched from somewhere; returns the overrides that choose
    it.
    """
    for name, content in {
        "experiment/evil.yaml": f"# @package _global_\n{text}\n",
        **files,
    }.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text(content)
    return [f"hydra.searchpath=[file://{folder}]", "experiment=evil"]


#: YAML of ten lines that unfolds to 1e10 values.
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10)
)
#: Names that would lead out of the folder of outputs.
WAYS_OUT = ("../../out", "/etc/out", "a/../../b", "..", "a\\..\\b", "a\nb")
#: What the settings in a checkpoint may not hold.
SETTINGS: dict[str, dict[str, Any]] = {
    "an instantiator": {"_instantiator": "os.system", "_class_path": "os.system"},
    "another key": {"checkpoint_path": "x"},
    "a target": {"method": {"name": "world_unet", "_target_": "os.system"}},
    "an object": {"loss": {"volume": torch.zeros(2)}},
    "a class": {"loss": {"volume": torch.float32}},
}


def pickles(sentinel: Path) -> dict[str, bytes]:
    """Pickles of every protocol that would make the sentinel, or take what torch's own list
    allows.
    """
    payload, text = Payload(f"touch {sentinel}"), f"touch {sentinel}".encode()
    found = {f"protocol {k}": pickle.dumps(payload, protocol=k) for k in range(6)}
    return found | {
        "instance": b"(S'" + text + b"'\nios\nsystem\n.",
        "obj": b"(cos\nsystem\nS'" + text + b"'\no.",
        "a dictionary's factory": pickle.dumps(defaultdict(print), protocol=2),
        "numpy": b"cnumpy._core.multiarray\n_reconstruct\n.",
        "a great many bytes": b"c__builtin__\nbytearray\n(L" + b"9" * 12 + b"L\ntR.",
        "torch's own loader": b"ctorch.storage\n_load_from_bytes\n(C\x00tR.",
        "an extension": b"\x82\x01.",
    }


def saved(value: Any) -> bytes:
    """The bytes that `torch.save` writes."""
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def with_pickle(archive: bytes, pickle: bytes) -> bytes:
    """A checkpoint with another pickle in it, every checksum right."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(archive)) as old,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as new,
    ):
        for member in old.infolist():
            new.writestr(
                member.filename,
                pickle if member.filename.endswith("data.pkl") else old.read(member),
            )
    return buffer.getvalue()


def pickle_of(archive: bytes) -> bytes:
    """The pickle in a checkpoint."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        return file.read(next(name for name in file.namelist() if name.endswith("data.pkl")))
