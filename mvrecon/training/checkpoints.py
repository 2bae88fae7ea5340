"""Write, read and check checkpoint files: atomic, with a checksum, and with the previous one
beside.

A file is a `torch.save` zip archive with the SHA-256 of all before it as the archive's comment,
which other programs ignore. Before torch reads a file, it is checked to be a plain archive of
tensors with a pickle that can build nothing else.
"""

import hashlib
import io
import pickletools
import re
import struct
import warnings
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.fabric.plugins import CheckpointIO
from torch import Tensor
from typing_extensions import TypedDict

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import MAX_TEXT_BYTES, Refused, file_errors, plain_name, shown
from mvrecon.core.options import parts_in
from mvrecon.core.parts import LOSSES, REGISTRIES, CameraPart, MethodPart, ProjectorPart
from mvrecon.training.targets import inside


def finished(folder: Path, method: str) -> Path:
    """The checkpoint of a method whose training has finished."""
    return folder / "checkpoints" / f"{plain_name(method, 'a method')}.ckpt"


def unfinished(folder: Path, method: str) -> Path:
    """The last checkpoint of a method in training."""
    return folder / "checkpoints" / plain_name(method, "a method") / "last.ckpt"


DIGEST_TAG = b"sha256:"
COMMENT_BYTES = len(DIGEST_TAG) + 64


class TrainingState(TypedDict, total=False, extra_items=Any):
    """What Lightning stores of a training, with the states of data and callbacks.

    Attributes:
        state_dict, current_model_state: weights; of averages those that are trained on.
        hyper_parameters: arguments of `ReconstructionModule`.
        callbacks: states by name.
        loops: progress of the loops.
        gradients: gradients of every process, in an accumulation that is not finished.
    """

    state_dict: dict[str, Tensor]
    current_model_state: dict[str, Tensor]
    hyper_parameters: Any
    global_step: int
    epoch: int
    callbacks: Any
    loops: Any
    gradients: dict[str, Tensor]


class DamagedCheckpoint(Refused):
    """A checkpoint whose bytes have changed since it was written."""


class DurableCheckpoints(CheckpointIO):
    """Lightning's interface to write, read and remove checkpoints; see `write` and `read_newest`.

    A restored checkpoint may ask Lightning to remove older ones; files outside the run folder are
    never removed.

    Args:
        folder: the run folder.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def save_checkpoint(
        self, checkpoint: TrainingState, path: Any, storage_options: Any = None
    ) -> None:
        """Write; see `write`.

        Raises:
            PermissionError: a path outside the folder.
        """
        write(inside(path, self.folder, "A checkpoint's path"), checkpoint)

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> TrainingState:
        """Read plain values and tensors; see `read_newest`."""
        return read_newest(Path(path))

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a file.

        Raises:
            PermissionError: a path outside the folder.
        """
        inside(path, self.folder, "A checkpoint's path").unlink(missing_ok=True)


def previous(path: Path) -> Path:
    """Path of the previous checkpoint of `path`."""
    return path.with_stem(f"{path.stem}.previous")


def not_finite(checkpoint: TrainingState) -> list[str]:
    """Names of the weight tensors, averaged or not, with an infinite value or NaN."""
    states = checkpoint.get("state_dict"), checkpoint.get("current_model_state")
    weights = (pair for state in states for pair in (state or {}).items())
    return [
        name for name, value in weights if isinstance(value, Tensor) and not value.isfinite().all()
    ]


def write(path: Path, checkpoint: TrainingState) -> None:
    """Write a checkpoint to `path`; an existing one is moved to `previous(path)`.

    After a full disk or a kill at any moment at least one of the two files is complete.

    Raises:
        FloatingPointError: weights that are not finite, which must not replace a good checkpoint.
        OSError: no space, no permission.
    """
    if bad := not_finite(checkpoint):
        raise FloatingPointError(
            f"{path} is not written: {len(bad)} weights are not finite, {bad[0]} among them"
        )
    buffer = io.BytesIO()
    torch.save(dict(checkpoint), buffer)
    # a zip archive ends with the length of its comment, and the comment
    buffer.seek(-2, io.SEEK_END)
    buffer.write(struct.pack("<H", COMMENT_BYTES))
    buffer.write(DIGEST_TAG + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())
    with written_whole(path, previous(path)) as part:
        part.write_bytes(buffer.getbuffer())


def read(path: Path) -> TrainingState:
    """Read a checkpoint of plain values and tensors and check mvrecon's checksum, if present.

    Raises:
        DamagedCheckpoint: a wrong checksum, or a file cut short.
        Refused: more than tensors and plain values, or weights that are not finite.
    """
    with open(path, "rb") as file:
        _verify(path, file)
        check_archive(path)
        file.seek(0)
        checkpoint = torch.load(file, map_location="cpu", weights_only=True)
    with file_errors(path, "is no checkpoint"):
        bad = not_finite(checkpoint)
    if bad:
        raise Refused(
            f"{path}: {len(bad)} weights are not finite, {shown(bad[0])} among them; expected "
            f"numbers"
        )
    return checkpoint


def remove(path: Path) -> None:
    """Remove a checkpoint and the previous one; then their folder, if empty."""
    for file in (path, previous(path)):
        file.unlink(missing_ok=True)
    with suppress(OSError):
        path.parent.rmdir()


def read_newest(path: Path) -> TrainingState:
    """Read the checkpoint at `path`, or if that is damaged the previous one, with a warning that
    names both.

    Raises:
        FileNotFoundError: neither exists.
        DamagedCheckpoint: neither can be read.
    """
    before = previous(path)
    try:
        return read(path)
    except (DamagedCheckpoint, FileNotFoundError) as error:
        if not before.exists():
            raise
        why = error if isinstance(error, DamagedCheckpoint) else f"{path} is missing"
        warnings.warn(
            f"{why}; resuming from the previous one, {before}", RuntimeWarning, stacklevel=2
        )
        return read(before)


def _verify(path: Path, file: BinaryIO) -> None:
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - COMMENT_BYTES))
    tail = file.read()
    if tail[-22:].startswith(b"PK\5\6"):  # an archive without a comment
        return
    if not tail.startswith(DIGEST_TAG):
        raise DamagedCheckpoint(
            f"{path}: is cut short or no checkpoint: {size} bytes, whose end is missing"
        )
    file.seek(0)
    digest, remaining = hashlib.sha256(), size - COMMENT_BYTES
    while block := file.read(min(remaining, 2**20)):
        digest.update(block)
        remaining -= len(block)
    if digest.hexdigest().encode() != tail[len(DIGEST_TAG) :]:
        raise DamagedCheckpoint(f"{path}: is damaged: its checksum does not fit its contents")


#: The files of `torch.save`'s archive, below one folder.
ARCHIVE_MEMBERS = re.compile(
    r"[^/\\]+/(data\.pkl|version|byteorder|\.format_version|\.storage_alignment|\.data/serialization_id|data/\d+)"
)
#: Globals allowed in a pickle, also if a library widens torch's own list.
ALLOWED_GLOBALS = re.compile(
    r"torch \w+Storage|torch\.storage UntypedStorage|torch "
    r"(Size|device|bfloat16|(float|u?int|complex)\d+|bool)"
    r"|torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict"
)
#: A pickle's opcodes for globals that `torch.save` does not use.
REFUSED_OPCODES = {"STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"}
#: The hyper-parameters of a method.
METHOD_KEYS = {"geometry", "method", "loss", "optimizer", "data_range"}


def check_archive(path: Path) -> None:
    """Check the archive and the pickle of a checkpoint without unpickling anything.

    Raises:
        Refused: not a zip archive of `torch.save`, compressed, with anything in its pickle but
        tensors and plain values, or wrong checksums, which torch does not verify.
    """
    with file_errors(path, "is cut short or no checkpoint"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if foreign := [m.filename for m in members if not ARCHIVE_MEMBERS.fullmatch(m.filename)]:
            raise Refused(f"{path}: holds {shown(foreign)}, which no checkpoint does")
        packed = any(m.compress_type != zipfile.ZIP_STORED for m in members)
        if packed or sum(m.file_size for m in members) > path.stat().st_size:
            raise Refused(
                f"{path}: its files are packed or overlap; expected them stored, as torch.save does"
            )
        pickles = [m for m in members if m.filename.endswith("/data.pkl")]
        if len(pickles) != 1 or pickles[0].file_size > MAX_TEXT_BYTES:
            raise Refused(
                f"{path}: has {len(pickles)} pickles; expected one of at most {MAX_TEXT_BYTES} "
                "bytes"
            )
        for op, what, _ in pickletools.genops(archive.read(pickles[0])):
            if op.name in REFUSED_OPCODES or (
                op.name == "GLOBAL" and not ALLOWED_GLOBALS.fullmatch(str(what))
            ):
                raise Refused(
                    f"{path}: its pickle names {shown(what or op.name)}; expected tensors and "
                    f"plain values only"
                )
        if damaged := archive.testzip():
            raise Refused(f"{path}: its {shown(damaged)} is damaged: the checksum does not fit")


def check_settings(path: Path, settings: Any) -> dict[str, Any]:
    """Return the hyper-parameters of a checkpoint, names and numbers under a method's keys, without
    loss terms of weight 0, whose plugins are not needed.

    Raises:
        Refused: other keys or values.
    """
    if isinstance(settings, dict) and "model" in settings:
        raise Refused(
            f"{path}: was written by mvrecon 0.1.0, expected 0.2.0 or later; train it "
            f"again, or use mvrecon 0.1.0"
        )
    right = isinstance(settings, dict) and set(settings) == METHOD_KEYS and _plain(settings)
    if not right or not isinstance(settings["loss"], dict):
        raise Refused(
            f"{path}: has the settings {shown(settings)}; expected names and numbers for "
            f"{sorted(METHOD_KEYS)}"
        )
    loss = {term: weight for term, weight in settings["loss"].items() if weight}
    return {**settings, "loss": loss}


def check_known(path: Path, settings: Mapping[str, Any]) -> None:
    """Check that all parts and loss terms of a checkpoint are registered.

    Raises:
        Refused: one is not, with the kind and name that a plugin must provide.
    """
    own = {key: settings["geometry"].get(key) for key in ("camera", "projector")}
    types = {"camera": CameraPart, "projector": ProjectorPart, "method": MethodPart}
    nodes = {**own, "method": settings["method"]}
    found = [part for key, node in nodes.items() for part in parts_in(node, types[key])]
    named = [(kind, node.get("name"), REGISTRIES[kind]) for _, kind, node in found]
    named += [("loss", term, LOSSES) for term in settings["loss"]]
    for kind, name, registry in named:
        if name not in registry.names():
            raise Refused(
                f"{path}: No {kind} is named {shown(name)} here; if a plugin brings it, "
                f"install that plugin, or import the module that registers it (plugins=[...] on a "
                f"command line)"
            )


def _plain(value: Any, depth: int = 0) -> bool:
    if depth > 16:
        return False
    if isinstance(value, Mapping):
        return all(
            type(k) is str and not k.startswith("_") and _plain(v, depth + 1)
            for k, v in value.items()
        )
    if isinstance(value, list | tuple):
        return len(value) < 2**16 and all(_plain(item, depth + 1) for item in value)
    return value is None or type(value) in (bool, int, float, str)
