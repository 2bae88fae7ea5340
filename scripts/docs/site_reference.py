"""The generated pages of the documentation's reference: the names of `mv.`, every public module,
and the options of all parts, read from signatures and docstrings as `mvrecon-list` does.
"""

import inspect
import re
from itertools import groupby
from pathlib import Path

import mvrecon
from mvrecon.apps.list import listed
from mvrecon.core.parts import Part
from mvrecon.core.signatures import REQUIRED, default_in_words, in_words

FOLDER = "reference/"
PACKAGE = Path(mvrecon.__file__).parent
#: The rooms, from the ground upwards.
ROOMS = {
    "core": "Registries, settings, files",
    "geometry": "Cameras, grids, geometry files",
    "kernels": "Compiled kernels and their reference",
    "operators": "Projectors and the algebra of operators",
    "methods": "Classical and learned reconstruction, calibration",
    "data": "Scans, volumes, scenes, detectors",
    "report": "Figures of merit, tables, pictures",
    "training": "Losses, checkpoints, the training of a run",
    "testing": "Contracts of parts, for your own tests",
    "apps": "The console commands",
}
#: Topics of the names of `mv.`, by the beginning of their module.
TOPICS = {
    "mvrecon.geometry": "Grids and cameras",
    "mvrecon.operators": "Projectors",
    "mvrecon.methods.classical": "Classical reconstruction",
    "mvrecon.methods": "Any method",
    "mvrecon.methods.calibration": "Calibration",
    "mvrecon.training": "Trained methods",
    "mvrecon.data": "Files and phantoms",
    "mvrecon.report": "Results",
}


def generated() -> dict[str, str]:
    """Every generated page by its path in the site."""
    pages = {f"{room}.md": modules(room, about) for room, about in ROOMS.items()}
    rooms = "".join(f"| [mvrecon.{room}]({room}.md) | {about} |\n" for room, about in ROOMS.items())
    pages |= {
        "modules.md": f"# Modules\n\n| package | contents |\n|---|---|\n{rooms}",
        "mv.md": front_door(sorted(set(dir(mvrecon)) - {"__version__"}, key=str.lower)),
        "options.md": options(listed()),
    }
    return {FOLDER + name: text for name, text in pages.items()}


def front_door(names: list[str]) -> str:
    """The page of `mv.`: an index by topic, then each name with the docstring of its object."""
    homes = {name: getattr(mvrecon, name).__module__ for name in names}
    lines = ["# mvrecon as mv", "", "The names of `mv` after `import mvrecon as mv`, by topic."]
    lines += ["Examples assume `import torch`, too."]
    members = {topic: [n for n in names if _topic(homes[n]) == topic] for topic in TOPICS.values()}
    for topic, group in members.items():
        lines += ["", f"**{topic}**", "", "| | |", "|---|---|"]
        for name in group:
            words = (inspect.getdoc(getattr(mvrecon, name)) or "").split("\n\n")[0].split()
            first = re.split(r"(?<=[.:]) ", " ".join(words))[0].rstrip(".:").replace("|", "\\|")
            lines += [f"| [`mv.{name}`](#{homes[name]}.{name}) | {first} |"]
    for topic, group in members.items():
        lines += ["", f"## {topic}"]
        for name in group:
            lines += ["", f"::: {homes[name]}.{name}", "    options:", f"      heading: mv.{name}"]
    return "\n".join(lines) + "\n"


def _topic(module: str) -> str:
    """Of the longest beginning of a module's name in `TOPICS`."""
    return TOPICS[max((room for room in TOPICS if module.startswith(room)), key=len)]


def modules(room: str, about: str) -> str:
    """The page of a room: every public module with its public names."""
    lines = [f"# mvrecon.{room}", "", f"{about}."]
    for file in sorted((PACKAGE / room).rglob("*.py")):
        parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
        if not any(part.startswith("_") for part in parts):
            lines += ["", f"## {'.'.join(parts[1:])}", "", f"::: {'.'.join(parts)}"]
    return "\n".join(lines) + "\n"


def options(parts: list[Part]) -> str:
    """The catalogue: every part of every kind with a table of its options."""
    lines = ["# Options of all parts", ""]
    lines += ["Generated from signatures and docstrings, as `mvrecon-list KIND` prints them."]
    for kind, members in groupby(parts, key=lambda part: part.kind):
        lines += ["", f"## {kind}"]
        for part in members:
            lines += ["", f"### {kind}: {part.name}", "", part.summary or part.error, ""]
            lines += [f"Source: `{part.origin}`", ""]
            if part.options:
                lines += ["| option | default | type | |", "|---|---|---|---|"]
            for name, option in part.options.items():
                default = (
                    "required"
                    if option.default is REQUIRED
                    else f"`{default_in_words(option.default)}`"
                )
                cells = (f"`{name}`", default, in_words(option.type), option.text)
                lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"]
    return "\n".join(lines) + "\n"
