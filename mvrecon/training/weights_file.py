"""Files of trained weights: safetensors, which hold no code, with a description under a checksum.

The metadata are JSON under the key `mvrecon`: `settings`, `training` and `sha256`, that of the
whole file with zeros in its place.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import MAX_TEXT_BYTES, Refused, file_errors, shown
from mvrecon.training.checkpoints import not_finite

#: Ending of such files; the key of their text.
ENDING, TEXT_KEY = ".safetensors", "mvrecon"
#: Placeholder of a file's SHA-256 while that is computed.
DIGEST_PLACEHOLDER = "0" * 64


def read(path: Path) -> tuple[Any, Any, dict[str, Tensor]]:
    """Settings, training record and weights of a file of `write`.

    Raises:
        FileNotFoundError: no such file.
        Refused: cut short or damaged, not mvrecon's, or weights that are not finite.
    """
    from safetensors import safe_open

    if not path.is_file():
        raise FileNotFoundError(f"No weights are at {path}")
    with file_errors(path, f"is no {ENDING} file"), safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get(TEXT_KEY, "")
        weights = {name: file.get_tensor(name) for name in file.keys()}
    if not 0 < len(text) <= MAX_TEXT_BYTES:
        raise Refused(
            f"{path}: expected a description under {TEXT_KEY!r} of at most {MAX_TEXT_BYTES} bytes"
        )
    with file_errors(path, "is not described by JSON"):
        record = json.loads(text)
        digest, settings, training = (record[key] for key in ("sha256", "settings", "training"))
        found = _digest(path.read_bytes(), digest)
    if digest != found:
        raise Refused(
            f"{path}: is damaged, or of an earlier version: expected the SHA-256 {shown(digest)}, "
            f"got {found}"
        )
    if bad := not_finite({"state_dict": weights}):
        raise Refused(f"{path}: {len(bad)} weights are not finite, {shown(bad[0])} among them")
    return settings, training, weights


def write(path: Path, settings: Any, training: Any, weights: Mapping[str, Tensor]) -> None:
    """Write a file of weights atomically.

    Raises:
        ValueError: settings with NaN or infinity.
    """
    from safetensors.torch import save

    record = {"sha256": DIGEST_PLACEHOLDER, "settings": dict(settings), "training": training}
    stored = {name: value.cpu().contiguous() for name, value in weights.items()}
    raw = save(stored, {TEXT_KEY: json.dumps(record, allow_nan=False)})
    with written_whole(path) as part:
        part.write_bytes(raw.replace(DIGEST_PLACEHOLDER.encode(), _digest(raw).encode(), 1))


def _digest(raw: bytes, digest: str = DIGEST_PLACEHOLDER) -> str:
    """SHA-256 of a file's bytes with zeros in place of the digest in its description."""
    return hashlib.sha256(raw.replace(digest.encode(), DIGEST_PLACEHOLDER.encode(), 1)).hexdigest()
