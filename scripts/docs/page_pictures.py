"""Draws the pictures that a page's own Python lines write: python scripts/docs/page_pictures.py
README.md

The blocks run in a temporary folder; a picture is copied to docs/images if there is one of its
name.
"""

import re
import subprocess
import sys
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

IMAGES = Path(__file__).parents[2] / "docs" / "images"


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.M | re.S)


def written(folder: Path) -> list[Path]:
    """The PNG files in a folder whose names are those of pictures in docs/images."""
    return [picture for picture in folder.glob("*.png") if (IMAGES / picture.name).exists()]


if __name__ == "__main__":
    page = Path(sys.argv[1]).absolute()
    with TemporaryDirectory() as work, chdir(work):
        subprocess.run([sys.executable, "-c", "\n".join(blocks(page, "python"))], check=True)
        for picture in written(Path(work)):
            (IMAGES / picture.name).write_bytes(picture.read_bytes())
