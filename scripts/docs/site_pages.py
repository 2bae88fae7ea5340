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
#: Pages of the repository, without the first one, in whose place the site has `LANDING`.
PATTERNS = ("*.md", "docs/*.md", "scripts/**/*.md", "plugins/*.md", "plugins/*/README.md")
PATTERNS += ("plugins/*/*/gpu/README.md", "experiments/**/*.md", "mvrecon/**/README.md")
DOCUMENTS = sorted({f for pattern in PATTERNS for f in ROOT.glob(pattern)} - {ROOT / "README.md"})
LANDING = """---
hide: [toc]
---

# mvrecon

mvrecon reconstructs volumes from X-ray and pinhole-SPECT views in PyTorch, with classical and
learned methods on the same differentiable projectors.

![A rig, its views, and one plane by four methods beside the truth](docs/images/teaser.png)

*What goes in: a rig and its views, here eight, six of them disturbed. What comes out: a volume,
here by four methods.*

- **A scan**: [reconstruct it](docs/scan.md).
- **Volumes, and an idea for a network**: [train on your own CTs](docs/train_on_cts.md),
  [write a plugin](plugins/README.md).
- **Pinhole SPECT projections**: [counts to activity](docs/spect.md).
- **PyTorch code that lacks projectors**: [operators and gradients](docs/tutorials/operators.md),
  [registration](docs/tutorials/register.md).

First [install](docs/install.md), then take ten minutes for
[three quick starts](docs/start.md). Reference: [all names of `mv`](reference/mv.md),
[all pages](docs/README.md).
"""
#: Lines of code are at most 100 characters wide, and so is their column; longer commands wrap.
STYLE = """@media (min-width: 76em) {
  .md-grid { max-width: 84rem; }
}
.md-typeset pre > code { font-size: 0.62rem; }
.md-typeset .language-bash pre > code {
  overflow-wrap: anywhere;
  white-space: pre-wrap;
}
.md-typeset td > a > code { white-space: nowrap; }
.md-typeset td:first-child > code { word-break: normal; }
"""
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
#: A Markdown link with its target, without its anchor.
LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)(?=[)#])")


def lay_out(page: str, out: Path, run: bool = True) -> None:
    """Copy a page and the files that it links to into the folder `out`, at the same paths."""

    def target(link: re.Match[str]) -> str:
        path = ((ROOT / page).parent / link[1]).resolve()
        if path in TUTORIALS:
            return f"{link[1].removesuffix('.py')}.md"
        return f"{link[1].rstrip('/')}/README.md" if path.is_dir() else link[1]

    script = (ROOT / page).with_suffix(".py")
    if script in TUTORIALS:
        return tutorials.write(script, (out / page).parent, run)
    text = LINK.sub(target, (ROOT / page).read_text(encoding="utf-8"))
    files = {((ROOT / page).parent / link).resolve() for link in LINK.findall(text)}
    for file in sorted(f for f in files if f.suffix != ".md" and f.is_relative_to(ROOT)):
        copy = out / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    (out / page).parent.mkdir(parents=True, exist_ok=True)
    (out / page).write_text(text, encoding="utf-8")


def main(out: Path, run: bool = True) -> None:
    """Write all pages into the folder `out`, which is emptied first; with `run`, the tutorials with
    what they print and draw.
    """
    shutil.rmtree(out, ignore_errors=True)
    scripts = [script.with_suffix(".md") for script in TUTORIALS]
    for page in [*DOCUMENTS, *scripts]:
        lay_out(str(page.relative_to(ROOT)), out, run)
    picture = out / "docs/images/teaser.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(ROOT / "docs/images/teaser.png", picture)
    (out / "site.css").write_text(STYLE, encoding="utf-8")
    for page, text in {"index.md": LANDING, **site_reference.generated()}.items():
        (out / page).parent.mkdir(parents=True, exist_ok=True)
        (out / page).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
