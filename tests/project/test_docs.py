"""The docs are true: their Python runs, their commands compose, their files, names and tests
exist.
"""

import ast
import importlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from PIL import Image

from mvrecon.apps import compare, view, warmup
from mvrecon.apps.config import compose
from mvrecon.apps.list import SETTING, listed
from mvrecon.apps.settings import RECORDS
from mvrecon.core.options import check
from mvrecon.core.parts import LISTED, PROJECTORS
from mvrecon.geometry.cameras.rigs import circular
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical.sirt import sirt
from mvrecon.testing import adjoint_gap
from scripts.docs import page_pictures, site_pages, site_reference
from scripts.docs.page_pictures import blocks

ROOT = Path(__file__).parents[2]
DOCS = [ROOT / "README.md", *site_pages.DOCUMENTS]
#: Files that a reader makes, that an app writes, and other projects' files.
ELSEWHERE = {
    "my_parts.py",
    "extra/load.py",
    "compare.md",
    "table.md",
    "targets.md",
    "page.md",
    "no.md",
}
#: Apps whose command line is not Hydra's.
PARSERS = {"compare": compare.parser, "view": view.parser, "warmup": warmup.parser}
if "spect" in PROJECTORS.names():  # the plugin
    from mvrecon_spect.apps import mtf, polarmap, psf

    PARSERS |= {
        app.parser().prog.removeprefix("mvrecon-"): app.parser for app in (mtf, polarmap, psf)
    }
#: Words of Lightning's that SECURITY.md forbids, and the pages that say so or that tell the past.
UNSAFE, HISTORY = "load_from_checkpoint", {"SECURITY.md", "CHANGELOG.md"}


def name_of(file: Path) -> str:
    return str(file.relative_to(ROOT))


@pytest.mark.parametrize("file", [f for f in DOCS if blocks(f, "python")], ids=name_of)
def test_the_python_of_a_page_runs(
    file: Path, registries: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """All blocks of a page one after the other; tests that they define are called. A picture that
    they write is that of docs/images.
    """
    monkeypatch.chdir(tmp_path)  # where they write
    space = {"__name__": "page"}
    for number, block in enumerate(blocks(file, "python"), 1):
        try:
            exec(compile(block, f"{name_of(file)}, block {number}", "exec"), space)  # noqa: S102
        except ImportError as error:
            if file.parent.name != "mvrecon-peers":  # whose libraries are the reader's choice
                raise
            pytest.skip(str(error))
    for test in [value for name, value in space.items() if name.startswith("test_")]:
        test()
    for picture in page_pictures.written(tmp_path):
        drawn, shown = (
            np.asarray(Image.open(f).convert("L"), float)
            for f in (picture, page_pictures.IMAGES / picture.name)
        )
        assert drawn.shape == shown.shape and np.abs(drawn - shown).mean() < 2, picture.name


def test_the_errors_that_the_readme_states_are_those_of_its_lines(
    registries: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    """That which its lines print, and that of the expression beside them."""
    monkeypatch.chdir(tmp_path)
    page, space = (ROOT / "README.md").read_text(), {"__name__": "page"}
    exec("\n".join(blocks(ROOT / "README.md", "python")), space)  # noqa: S102
    printed = re.findall(r"error: ([\d.]+)%", capsys.readouterr().out)
    expression = re.search(r"`(mv\.fista_tv\([^`]+\))`\s+gives ([\d.]+) %", page)
    assert expression is not None
    volume: Any = eval(expression[1], space)  # noqa: S307
    mv: Any = space["mv"]
    scan: Any = space["scan"]
    assert printed == re.findall(r"error of ([\d.]+) %", page)
    assert f"{100 * mv.nrmse(volume[0, 0], scan.volume[0]):.1f}" == expression[2]


def test_the_projector_that_the_plugins_page_prints_reconstructs(registries: None):
    detector = {"pixels": [6, 6], "pixel_mm": 1.0}
    page = "\n".join(blocks(ROOT / "plugins" / "README.md", "python"))
    exec(page, {"__name__": "page"})  # noqa: S102
    grid, rig = Grid.centred(6, spacing=1.0), circular(1, 40.0, 70.0, detector)
    A = PROJECTORS.build("sum_along_y", grid=grid, cameras=rig).to("cpu")
    x = torch.rand(2, 1, *grid.shape, dtype=torch.float64)
    y = torch.rand_like(A(x))
    assert adjoint_gap(A, x, y) < 1e-12
    torch.testing.assert_close(A(x)[0, 0, 0], x[0, 0].sum(dim=1))
    torch.testing.assert_close((2 * A)(sirt(A, y, iterations=2)), 2 * y)


def commands() -> Iterator[tuple[str, str]]:
    """Every command line of ours with the page that shows it, in blocks and inside sentences."""
    for file in DOCS:
        text = "\n".join([*blocks(file, "bash"), *blocks(file, "")]).replace("\\\n", " ")
        spans = re.findall(r"`(mvrecon-[a-z]+ [^`]+)`", file.read_text())
        for line in [*text.splitlines(), *(" ".join(span.split()) for span in spans)]:
            for part in re.split(r"&&|;", line):
                if re.match(r"(\w+=\S+ )*(\.venv/bin/)?mvrecon-[a-z]+( |$)", part.strip()):
                    yield name_of(file), part.strip()


def pages_of_commands() -> dict[str, set[str]]:
    """Each command, without its remark, and all pages that show it."""
    pages: dict[str, set[str]] = {}
    for page, command in sorted(commands()):
        pages.setdefault(command.partition(" #")[0].strip(), set()).add(page)
    return pages


@pytest.mark.parametrize(("command", "pages"), pages_of_commands().items())
def test_a_command_of_a_page_composes(command: str, pages: set[str]):
    words = shlex.split(re.sub(r"<\w+>", "name", command), comments=True)
    first = next(i for i, word in enumerate(words) if "mvrecon-" in word)
    app = words[first].rpartition("mvrecon-")[2]
    # the reader's scan.yaml names the views
    options = [re.sub("^scan=", "views.path=", word) for word in words[first + 1 :]]
    if app == "list":
        parts = {name for kind in options if kind in LISTED for name in LISTED[kind].names()}
        known = {*LISTED, SETTING, *parts, "--check", "--new-plugin", "my_plugin"}
        known.add("plugins=[my_parts]")
        assert set(options) <= known, command
        return
    if app in PARSERS:
        PARSERS[app]().parse_args(options)
        return
    given = OverridesParser.create().parse_overrides([w for w in options if not w.startswith("-")])
    for run in {tuple(values(line)[end] for line in given) for end in (0, -1)}:
        settings = composed(app, *run)
        if pages - HISTORY and app in RECORDS and not settings.get("plugins"):
            check(settings, RECORDS[app])


@cache
def composed(app: str, *options: str) -> dict[str, Any]:
    """The settings of an app with these options, which pages may share."""
    return compose(*options, config_name=app)


def values(given: Override) -> list[str]:
    """A setting of a command line; of a sweep, with every value."""
    if not given.is_sweep_override():
        return [str(given.input_line)]
    return [f"{given.get_key_element()}={value}" for value in given.sweep_string_iterator()]


def test_pages_show_commands_of_every_app():
    shown = {re.search(r"mvrecon-([a-z]+)", command)[1] for _, command in commands()}  # type: ignore[index]
    assert shown >= {"train", "eval", "list", "bench", "stress"}


@cache
def docstrings(file: Path) -> str:
    """Every docstring of a module."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = ast.walk(ast.parse(file.read_text()))
    return "\n".join(ast.get_docstring(n) or "" for n in nodes if isinstance(n, documented))


def told(folders: tuple[str, ...] = ("mvrecon", "plugins", "scripts", "tests")) -> dict[str, str]:
    """All that is told to a reader: pages, and the docstrings of each module."""
    modules = [f for folder in folders for f in sorted((ROOT / folder).rglob("*.py"))]
    texts = {name_of(f): docstrings(f) for f in modules}
    return texts | {name_of(f): f.read_text() for f in DOCS}


def test_a_file_that_is_mentioned_is_there():
    """By the end of its path, as `geometry/grid.py`."""
    folders = ("mvrecon", "plugins", "scripts", "tests", "docs", "experiments", "conf")
    files = [*ROOT.glob("*.*"), *(f for folder in folders for f in (ROOT / folder).rglob("*.*"))]
    ends = {"/".join(f.parts[k:]) for f in files for k in range(len(ROOT.parts), len(f.parts))}
    missing = {
        f"{page}: {path}"
        for page, text in told().items()
        if page != "CHANGELOG.md"
        for path in re.findall(r"(?<![\w.*<>/-])[\w./-]*\w\.(?:py|md)\b", text)
        if path not in ELSEWHERE and re.sub(r"^(\.\./|\./|/)*", "", path) not in ends
    }
    assert missing == set()


def anchors(page: str) -> set[str]:
    """The anchors of a page's headings: small letters, hyphens for spaces, no other signs."""
    text = re.sub(r"^ *```.*?^ *```", "", page, flags=re.M | re.S)
    titles = re.findall(r"^#+ +(.*)", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text), re.M)
    documented = re.findall(r"^::: (\S+)", text, re.M)  # of a page of the reference
    made = {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in titles}
    return made | {*documented}


def broken(file: Path) -> list[str]:
    """The links of a page to files, folders and headings of the project that are not there."""
    links = re.findall(r"\]\(([^)\s#]*)#?([^)\s]*)\)", file.read_text())
    missing = []
    for path, anchor in [link for link in links if "://" not in link[0]]:
        target = file.parent / path if path else file
        target = target / "README.md" if anchor and target.is_dir() else target
        differs = "--" in anchor  # between GitHub and the site, which joins hyphens
        if not target.exists() or differs or anchor and anchor not in anchors(target.read_text()):
            missing.append(f"{path}#{anchor}")
    return missing


@pytest.mark.parametrize("file", DOCS, ids=name_of)
def test_a_link_leads_somewhere(file: Path):
    assert broken(file) == []


def test_a_broken_link_is_recognised(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("# Two words, `code`\n[a](page.md#two-words-code) [b](#no) [c](no.md)\n")
    assert broken(page) == ["#no", "no.md#"]


def test_every_page_is_in_the_site_and_its_links_stay_within(tmp_path: Path):
    """Laid out by scripts/docs/site_pages.py: no page is forgotten, links still lead somewhere."""
    site_pages.main(tmp_path, run=False)
    laid_out = {str(f.relative_to(tmp_path)): f for f in tmp_path.rglob("*.md")}
    tutorials = {name_of(script.with_suffix(".md")) for script in site_pages.TUTORIALS}
    made = {"index.md", *site_reference.generated()}
    assert set(laid_out) == {*map(name_of, site_pages.DOCUMENTS), *tutorials, *made}
    entries = re.findall(r": ([\w./-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    assert set(entries) <= set(laid_out) and len(entries) <= 40
    linked = {
        str((file.parent / link).resolve().relative_to(tmp_path.resolve()))
        for file in laid_out.values()
        for link in re.findall(r"\]\(([^)\s#:]+\.md)", file.read_text())
    }
    assert set(laid_out) - set(entries) - linked == set()  # every page is in the menu or linked
    assert {page: broken(file) for page, file in laid_out.items() if broken(file)} == {}
    pages = {file.name for file in (ROOT / "docs").glob("*.md")} - {"README.md"}
    listed = re.findall(r"\]\((\w+\.md)\)", (ROOT / "docs" / "README.md").read_text())
    assert sorted(listed) == sorted(pages)
    folders = [
        link
        for file in laid_out.values()
        for link in re.findall(r"\]\(([^)\s#:]+)\)", file.read_text())
        if (file.parent / link).is_dir()
    ]
    assert folders == []  # a site has pages, no folders


def test_the_reference_has_every_public_module_and_every_option():
    pages = site_reference.generated()
    named = set(re.findall(r"^::: ([\w.]+)$", "\n".join(pages.values()), re.M))
    files = [f.relative_to(ROOT).with_suffix("") for f in (ROOT / "mvrecon").rglob("*.py")]
    public = {".".join(f.parts) for f in files if not any(p.startswith("_") for p in f.parts)}
    assert {name for name in public if not name.startswith("mvrecon.template")} <= named
    for part in listed():
        assert f"### {part.kind}: {part.name}\n" in pages["reference/options.md"]
        for option, value in part.options.items():
            assert f"| `{option}` | " in pages["reference/options.md"], (part.name, value)


def test_a_picture_of_the_docs_has_a_command_and_is_small():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    pictures = list(page_pictures.IMAGES.iterdir())
    assert [picture.name for picture in pictures if f"`{picture.name}`" not in text] == []
    assert max(picture.stat().st_size for picture in pictures) < 400_000


def test_a_module_or_name_that_is_mentioned_is_there():
    """`mvrecon.operators.drr.Drr`, whole, in a page or a docstring."""
    missing = {
        f"{page}: {name}"
        for page, text in told().items()
        if page != "CHANGELOG.md"
        for name in re.findall(r"`(mvrecon(?:_\w+)?(?:\.\w+)+)[`(]", text)
        if name != "mvrecon.plugins" and not importable(name)  # the group of entry points
    }
    assert missing == set()


def importable(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    module, _, attribute = name.rpartition(".")
    try:
        importlib.import_module(name)
    except ImportError:
        try:
            return hasattr(importlib.import_module(module), attribute)
        except ImportError:
            return False
    return True


def test_a_test_that_a_page_names_is_there():
    names = {name for f in DOCS for name in re.findall(r"`(test_\w+)`", f.read_text())}
    folders = (ROOT / "tests", *ROOT.glob("plugins/*/tests"))
    code = "\n".join(f.read_text() for folder in folders for f in folder.rglob("test_*.py"))
    assert len(names) > 20
    assert [name for name in sorted(names) if f"def {name}(" not in code] == []


def test_nobody_is_told_to_load_a_checkpoint_unseen():
    texts = told(("mvrecon", "plugins", "scripts"))
    assert [p for p, text in texts.items() if UNSAFE in text and p not in HISTORY] == []


def test_the_layers_that_contributors_read_are_those_that_are_checked():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(c["layers"] for c in contracts["contracts"] if c["type"] == "layers")
    rule = re.search(
        r"Imports run downward only.*?`core`[^.]*\.",
        (ROOT / "CONTRIBUTING.md").read_text(),
        re.S,
    )
    assert rule is not None
    rows = [set(re.findall(r"`(\w+)`", row)) for row in rule[0].split(";")]
    assert rows == [set(re.split(r" \| ", layer)) for layer in layers]
