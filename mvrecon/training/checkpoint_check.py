"""Check a checkpoint file before torch reads it: a plain zip archive of tensors, and a pickle that
can build nothing else.
"""

import pickletools
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mvrecon.core.files.checks import TEXT, Refused, file_errors, shown
from mvrecon.core.parts import LOSSES, REGISTRIES
from mvrecon.core.signatures import parts_in
from mvrecon.training.losses import TERMS

#: The files that `torch.save` puts into an archive, below one folder.
MEMBERS = re.compile(
    r"[^/\\]+/(data\.pkl|version|byteorder|\.format_version|\.storage_alignment|\.data/serialization_id|data/\d+)"
)
#: What a pickle may name, so that no library that widens torch's own list widens this one.
GLOBALS = re.compile(
    r"torch \w+Storage|torch\.storage UntypedStorage|torch "
    r"(Size|device|bfloat16|(float|u?int|complex)\d+|bool)"
    r"|torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict"
)
#: Ways of a pickle to name things that `torch.save` does not use.
FOREIGN = {"STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"}
#: The hyper-parameters of a method.
KEYS = {"geometry", "method", "loss", "optimizer", "data_range"}


def check_archive(path: Path) -> None:
    """Check the archive and the pickle of a checkpoint without unpickling anything.

    Raises:
        Refused: not a zip archive as `torch.save` writes it, packed so that it unfolds to more than
            it is, with anything in its pickle but tensors and plain values, or bytes that do not
            fit their checksums, which torch does not compare.
    """
    with file_errors(path, "is cut short or no checkpoint"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if foreign := [m.filename for m in members if not MEMBERS.fullmatch(m.filename)]:
            raise Refused(f"{path}: holds {shown(foreign)}, which no checkpoint does")
        packed = any(m.compress_type != zipfile.ZIP_STORED for m in members)
        if packed or sum(m.file_size for m in members) > path.stat().st_size:
            raise Refused(
                f"{path}: its files are packed or overlap; expected them stored, as torch.save does"
            )
        pickles = [m for m in members if m.filename.endswith("/data.pkl")]
        if len(pickles) != 1 or pickles[0].file_size > TEXT:
            raise Refused(
                f"{path}: has {len(pickles)} pickles; expected one of at most {TEXT} bytes"
            )
        for op, what, _ in pickletools.genops(archive.read(pickles[0])):
            if op.name in FOREIGN or (op.name == "GLOBAL" and not GLOBALS.fullmatch(str(what))):
                raise Refused(
                    f"{path}: its pickle names {shown(what or op.name)}; expected tensors and "
                    f"plain values only"
                )
        if damaged := archive.testzip():
            raise Refused(f"{path}: its {shown(damaged)} is damaged: the checksum does not fit")


def check_settings(path: Path, settings: Any) -> dict[str, Any]:
    """The hyper-parameters of a checkpoint: names and numbers under the keys of a method, and
    nothing else.

    Raises:
        Refused: other keys or other values.
    """
    if isinstance(settings, dict) and "model" in settings:
        raise Refused(f"{path}: was written by mvrecon 0.1.0; v0.1.0 reads it")
    if not isinstance(settings, dict) or set(settings) != KEYS or not _plain(settings):
        raise Refused(
            f"{path}: has the settings {shown(settings)}; expected names and numbers for "
            f"{sorted(KEYS)}"
        )
    return settings


def check_known(path: Path, settings: Mapping[str, Any]) -> None:
    """Check that every part and every term of the loss which a checkpoint names is there.

    Raises:
        Refused: one is not; the message says which kind and name a plugin must bring.
    """
    named = [(kind, node["name"], REGISTRIES[kind]) for _, kind, node in parts_in(settings)]
    named += [("loss", term, LOSSES) for term in settings.get("loss", ()) if term not in TERMS]
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
