"""Damaged copies of a file, and what a reader makes of them; for tests of any reader, a plugin's
included.
"""

import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from mvrecon.core.machine import peak

#: What a reader may raise; its message names the file.
REFUSALS = (ValueError, OSError, KeyError)
#: Integers and floats at the ends of their ranges, as files hold them.
EXTREMES = [
    value.to_bytes(size, order)
    for size in (1, 2, 4, 8)
    for value in (0, 2 ** (8 * size - 1) - 1, 2 ** (8 * size) - 1)
    for order in ("little", "big")
] + [
    struct.pack(kind, value)
    for kind in ("<f", "<d")
    for value in (float("nan"), float("inf"), -1e30)
]


def mutations(data: bytes, rng: Random, count: int) -> Iterator[bytes]:
    """Damaged copies of a file's bytes: cut short, bits flipped, numbers made extreme, blocks lost,
    moved or added.

    Args:
        data: the whole file; not empty.
        rng: chooses; the same state gives the same copies.
        count: of copies. The kinds take turns.
    """
    kinds = (_cut, _flipped, _extreme, _lost, _moved, _longer)
    for k in range(count):
        yield kinds[k % len(kinds)](data, rng)


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _flipped(data: bytes, rng: Random) -> bytes:
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        damaged[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def _extreme(data: bytes, rng: Random) -> bytes:
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        place, value = _place(data, rng), rng.choice(EXTREMES)
        damaged[place : place + len(value)] = value
    return bytes(damaged)


def _lost(data: bytes, rng: Random) -> bytes:
    place = _place(data, rng)
    return data[:place] + data[place + rng.choice((1, 4, 64, 512)) :]


def _moved(data: bytes, rng: Random) -> bytes:
    length, source, target = rng.choice((4, 16, 256)), _place(data, rng), _place(data, rng)
    block = data[source : source + length]
    return data[:target] + block + data[target + len(block) :]


def _longer(data: bytes, rng: Random) -> bytes:
    place = rng.choice((len(data), _place(data, rng)))
    added = rng.choice((b"\0", b"\xff", data[:64] or b"\0", rng.randbytes(16))) * rng.choice(
        (1, 64, 4096)
    )
    return data[:place] + added + data[place:]


def _place(data: bytes, rng: Random) -> int:
    """Mostly among the first bytes, where formats keep what they say about themselves."""
    return rng.randrange(min(len(data), rng.choice((64, 512, 4096, len(data)))))


@dataclass
class Tally:
    """What a reader made of damaged files.

    Args:
        inputs: files given to it.
        read: files that it read, for the damage left them valid.
        seconds: the slowest took, of this process's own time.
        peak: bytes by which this process's largest size grew, native libraries included; 0 where no
            one tells.
        failures: what must not be: another exception, a message without the file's name, other
            values where a format has checksums; a line each.
    """

    inputs: int = 0
    read: int = 0
    seconds: float = 0.0
    peak: int = 0
    failures: list[str] = field(default_factory=list)


def tally(
    read: Callable[[Path], object], cases: Iterable[bytes], path: Path, whole: bytes | None = None
) -> Tally:
    """Give every case to a reader, as the file `path`, and note what it does; nothing is raised.

    Args:
        read: the reader.
        cases: damaged files.
        path: where each is put.
        whole: for a format with checksums, the file without damage: what is read of a damaged one
            are the values of it.
    """
    expected = None
    if whole is not None:
        path.write_bytes(whole)
        expected = values(read(path))
    found, before = Tally(), peak() or 0
    for case in cases:
        path.write_bytes(case)
        start = time.process_time()
        try:
            result = read(path)
            found.read += 1
            if expected is not None and values(result) != expected:
                found.failures.append(
                    f"case {found.inputs}: read, with other values than the file without damage"
                )
        except REFUSALS as error:
            if path.name not in str(error):
                found.failures.append(
                    f"case {found.inputs}: {type(error).__name__} without the file's name: {error}"
                )
        except Exception as error:  # whatever it is, a reader must not raise it
            found.failures.append(f"case {found.inputs}: {type(error).__name__}: {error}")
        found.seconds = max(found.seconds, time.process_time() - start)
        found.inputs += 1
    found.peak = (peak() or 0) - before
    return found


def values(result: Any) -> Any:
    """What a reader returned, as plain values that can be compared to the last bit."""
    if isinstance(result, torch.nn.Module):
        return values(result.state_dict())
    if isinstance(result, torch.Tensor | np.ndarray):
        array = np.asarray(result)
        return array.shape, str(array.dtype), array.tobytes()
    if is_dataclass(result):
        return [values(getattr(result, part.name)) for part in fields(result)]
    if isinstance(result, Mapping):
        return [(key, values(value)) for key, value in result.items()]
    return [values(item) for item in result] if isinstance(result, list | tuple) else result
