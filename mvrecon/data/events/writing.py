"""Write a data set of events: in parallel, a file at a time, going on where a run was stopped."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
from rich.console import Console
from rich.progress import track
from torch.utils.data import DataLoader, Dataset

from mvrecon.core.files.atomic import written_whole
from mvrecon.core.files.checks import Refused, shown, text_of
from mvrecon.data.digests import files_in, of_file
from mvrecon.data.events.making import EventMaker
from mvrecon.data.events.shards import Header, fill, header_of, verify, write_shard
from mvrecon.kernels.threads import in_one_order

#: The file of the shards' SHA-256 digests, as `sha256sum --check` reads it.
SUMS = "SHA256SUMS"
#: Raised where the same settings make other events.
VERSION = 1
#: How much larger than the first event the mean one may be.
MARGIN = 1.2


def write_events(folder: Path, maker: EventMaker, made_of: Mapping[str, Any]) -> list[Path]:
    """Write all events that are missing in a folder, and return the paths of all files.

    A file is written whole or not at all, and depends on nothing but the settings and its number: a
    run that is stopped anywhere goes on, with the same bytes for any number of workers. Files that
    are there are checked first.

    Args:
        folder: of the files; the caller has claimed it (`mvrecon.core.files.atomic.claimed`).
        maker: of the events.
        made_of: settings of the app, of which the events depend on those of `DEPENDS`.

    Raises:
        OSError: the disk has less room than the files need.
        Refused: a file of other settings, or a damaged one, is in the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    affine = tuple(maker.grid.affine.flatten().tolist())
    header = Header(digest_of(made_of), maker.seed, affine, maker.columns)
    paths = [folder / f"events-{k:05d}.h5" for k in range(maker.settings.shards)]
    sums = {path.name: _checked(path, maker, k, header) for k, path in enumerate(paths)}
    sums = {name: digest for name, digest in sums.items() if digest}
    missing = [k for k, path in enumerate(paths) if path.name not in sums]
    _write_sums(folder, sums)
    if missing:
        check_room(folder, maker, sum(len(maker.settings.indices(k)) for k in missing))
    jobs = _Jobs(maker, header, [(k, paths[k]) for k in missing])
    with in_one_order():  # one thread of torch, as in worker processes: the bits are theirs
        made = DataLoader(jobs, batch_size=None, num_workers=maker.settings.workers)
        console = Console(stderr=True)
        for name, digest in track(made, "Events", len(missing), transient=True, console=console):
            sums[name] = digest
            _write_sums(folder, sums)
    return paths


#: The settings that events depend on.
DEPENDS = ("seed", "grid", "scene", "camera", "projector", "acquisition", "events")


def digest_of(settings: Mapping[str, Any]) -> str:
    """Digest of all that the events of some settings depend on, their files included."""
    parts = {name: settings[name] for name in DEPENDS}
    parts["events"] = {k: v for k, v in parts["events"].items() if k != "workers"}
    parts["files"] = {path: of_file(path) for path in sorted(set(files_in(parts)))}
    text = json.dumps([VERSION, parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def bytes_of(maker: EventMaker) -> int:
    """Bytes that the first event takes in a file."""
    with h5py.File("event", "w", driver="core", backing_store=False) as file:
        fill(file, 1, [maker(maker.settings.first)])
        return sum(array.id.get_storage_size() for array in file.values())


def check_room(folder: Path, maker: EventMaker, count: int) -> None:
    """Tell how much disk so many events take, judged by the first one.

    Raises:
        OSError: less is free.
    """
    need, free = round(MARGIN * count * bytes_of(maker)), shutil.disk_usage(folder).free
    text = f"{count} events need up to {need / 2**30:.2f} GiB; {free / 2**30:.2f} GiB are free"
    if need > free:
        raise OSError(f"{folder}: {text}. Choose another folder by hydra.run.dir=..., or fewer")
    Console(stderr=True, highlight=False).print(f"{text}.")


class _Jobs(Dataset[tuple[str, str]]):
    """Files to be made; an item is a file's name and digest, and has written it."""

    def __init__(self, maker: EventMaker, header: Header, jobs: list[tuple[int, Path]]):
        self.maker, self.header, self.jobs = maker, header, jobs

    def __len__(self) -> int:
        return len(self.jobs)

    def __getitem__(self, item: int) -> tuple[str, str]:
        shard, path = self.jobs[item]
        write_shard(path, self.header, self.maker.settings.indices(shard), self.maker)
        return path.name, of_file(path)


def _checked(path: Path, maker: EventMaker, shard: int, header: Header) -> str | None:
    """Digest of a file that is there and sound; None where there is none."""
    if not path.exists():
        return None
    got, count = header_of(path)
    if got != header or count != len(maker.settings.indices(shard)):
        raise Refused(
            f"{path}: is of other settings: got {count} events, settings {got.settings[:16]}, "
            f"expected {len(maker.settings.indices(shard))}, {header.settings[:16]}; choose "
            f"another folder by hydra.run.dir=..."
        )
    digest, expected = of_file(path), _sums(path.parent).get(path.name)
    if expected is None:
        verify(path)
    elif digest != expected:
        raise Refused(
            f"{path}: is damaged: got sha256 {digest[:16]}, expected {expected[:16]} as in "
            f"{SUMS}; delete it to have it made again"
        )
    return digest


def _sums(folder: Path) -> dict[str, str]:
    path = folder / SUMS
    if not path.is_file():
        return {}
    lines = [line.split("  ") for line in text_of(path).splitlines()]
    if any(len(line) != 2 for line in lines):
        raise Refused(f"{path}: expected lines of a digest and a name, got {shown(lines)}")
    return {name: digest for digest, name in lines}


def _write_sums(folder: Path, sums: Mapping[str, str]) -> None:
    with written_whole(folder / SUMS) as part:
        part.write_text("".join(f"{sums[name]}  {name}\n" for name in sorted(sums)))
