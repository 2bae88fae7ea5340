"""A folder that belongs to one run: locked while it is at work, with settings and measurements that
do not change.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from mvrecon.cameras import files
from mvrecon.data import digests
from mvrecon.data.module import SceneData
from mvrecon.engine import record
from mvrecon.engine.old_names import current
from mvrecon.files.atomic import claimed
from mvrecon.files.checks import Refused, blaming, shown, text_of, yaml_of

DIGESTS, RIG = "digests.json", "rig.json"
#: What a folder without settings of its own must not hold: the work of a run that nobody could
#: tell.
WORK = (record.SETTINGS, record.RESULTS, "checkpoints", "cases")


@contextmanager
def taken(folder: Path, settings: Mapping[str, Any], file: str = record.SETTINGS) -> Iterator[None]:
    """A run folder that is this process's meanwhile, new or with the very settings that it had;
    they are written down.

    Raises:
        RuntimeError: another process is at work in the folder.
        ValueError, FileExistsError: it is another run's; see `check`.
    """
    with claimed(folder):
        check(folder, settings, file)
        record.start(folder, dict(settings), file)
        yield


def check(folder: Path, settings: Mapping[str, Any], file: str = record.SETTINGS) -> None:
    """Compare settings with those that a folder's run was started with; nothing is written.

    Raises:
        ValueError: they differ; the message names each that does.
        FileExistsError: results are there, and no settings of theirs.
    """
    remedy = "choose another folder by hydra.run.dir=..."
    if not (folder / file).is_file():
        if work := [name for name in WORK if (folder / name).exists()]:
            raise FileExistsError(
                f"{folder} holds {', '.join(work)} of another run without its {file}; {remedy}"
            )
        return
    kept = current(yaml_of(folder / file))
    plain = yaml.safe_load(yaml.safe_dump(dict(settings)))
    if changed := differences(plain, kept):
        raise ValueError(
            f"{folder} is the folder of a run with other settings: {'; '.join(changed)}; {remedy}"
        )


def differences(got: Any, expected: Any, key: str = "") -> list[str]:
    """The settings that differ, by their full names, each with what was got and what was expected.

    One that is missing is as one that is null.
    """
    if isinstance(got, Mapping) and isinstance(expected, Mapping):
        names = {f"{key}.{name}".lstrip("."): name for name in (*got, *expected)}
        return [
            line
            for full, name in names.items()
            for line in differences(got.get(name), expected.get(name), full)
        ]
    return [] if got == expected else [f"got {key}={shown(got)}, expected {shown(expected)}"]


def keep_measurement(folder: Path, data: SceneData) -> None:
    """Keep a run's rig, and the digests of its rig and its data files; or compare them with those
    kept before.

    Raises:
        Refused: the rig or a file is not what the run began with.
    """
    if (folder / DIGESTS).is_file():
        compare_measurement(folder, data.digests("train", "test"))
        return
    files.save(data.cameras, folder / RIG)
    record.write(folder / DIGESTS, json.dumps(data.digests("train", "test"), indent=1) + "\n")


def compare_measurement(folder: Path, got: Mapping[str, str]) -> None:
    """Compare digests with those that a run folder keeps, if it does.

    Raises:
        Refused: the rig or a file differs, or the file of digests is none.
    """
    path = folder / DIGESTS
    if not path.is_file():
        return
    with blaming(path, "is not JSON"):
        kept = json.loads(text_of(path))
    if not isinstance(kept, dict):
        raise Refused(f"{path}: expected digests by name, got {shown(kept)}")
    digests.compare(got, kept, f"{path} (its rig is kept as {RIG})")
