"""Lays out the pages of the documentation's site: python -m scripts.docs.site_pages OUT_FOLDER

The site is made of the same files that a reader of the repository sees, in the same folders, so
that their links are right in both. A link to a folder becomes one to its README.md, the files that
pages link to are copied beside them, and a tutorial's script becomes a page with its output and
pictures, and a notebook. The pages of the reference are generated: scripts/docs/site_reference.py.
"""

import re
import shutil
import sys
from pathlib import Path

from scripts.docs import site_reference, tutorials

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
#: A Markdown link with its target, without its anchor.
LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)(?=[)#])")


def pages(config: str) -> list[str]:
    """The pages that the navigation of mkdocs.yml names, without those that are generated."""
    named = re.findall(r"[\w./-]+\.md$", config, re.M)
    return [page for page in named if not page.startswith(site_reference.FOLDER)]


def lay_out(page: str, out: Path, run: bool = True) -> None:
    """Copy a page and the files that it links to into the folder `out`, at the same paths."""

    def target(link: re.Match[str]) -> str:
        path = ((ROOT / page).parent / link[1]).resolve()
        if path in TUTORIALS:
            return f"{link[1].removesuffix('.py')}.md"
        return f"{link[1].rstrip('/')}/README.md" if path.is_dir() else link[1]

    script = (ROOT / page).with_suffix(".py")
    if script in TUTORIALS:
        return _tutorial(script, (out / page).parent, run)
    text = LINK.sub(target, (ROOT / page).read_text(encoding="utf-8"))
    files = {((ROOT / page).parent / link).resolve() for link in LINK.findall(text)}
    for file in sorted(f for f in files if f.suffix != ".md" and f.is_relative_to(ROOT)):
        copy = out / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    (out / page).parent.mkdir(parents=True, exist_ok=True)
    (out / page).write_text(text, encoding="utf-8")


def _tutorial(script: Path, folder: Path, run: bool) -> None:
    """A tutorial's page and notebook; without `run` nothing of it is executed."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{script.stem}.ipynb").write_text(tutorials.notebook(script), encoding="utf-8")
    text = f"{tutorials.page(script, folder, run)}\n[As a notebook]({script.stem}.ipynb)\n"
    (folder / f"{script.stem}.md").write_text(text, encoding="utf-8")


def main(out: Path, run: bool = True) -> None:
    """Write all pages of mkdocs.yml into the folder `out`, which is emptied first; with `run`, the
    tutorials with what they print and draw.
    """
    shutil.rmtree(out, ignore_errors=True)
    for page in pages((ROOT / "mkdocs.yml").read_text(encoding="utf-8")):
        lay_out(page, out, run)
    for page, text in site_reference.generated().items():
        (out / page).parent.mkdir(parents=True, exist_ok=True)
        (out / page).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
