"""Write a project with one part of every kind, for the author of a plugin to start from."""

import keyword
from pathlib import Path

#: The project; `my_plugin` in paths and texts stands for its name, and files end in `.txt`, so that
#: nothing takes them for mvrecon's own.
TEMPLATE = Path(__file__).with_name("template")
STAND_IN = "my_plugin"


def new_plugin(name: str, parent: Path) -> list[Path]:
    """Write a pip-installable project into the new folder `parent / name`; returns its files.

    Raises:
        ValueError: a name that is none for a package of Python's, or is mvrecon's.
        FileExistsError: the folder is there already.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        raise ValueError(
            f"Expected the name of a Python package, as in my_parts (a-z, 0-9, _), got {name!r}"
        )
    if name.partition("_")[0] == "mvrecon":
        raise ValueError(f"Expected a name that does not begin with mvrecon, got {name!r}")
    folder = parent / name
    folder.mkdir(parents=True)
    written = []
    for file in sorted(TEMPLATE.rglob("*.txt")):
        place = str(file.relative_to(TEMPLATE)).removesuffix(".txt").replace(STAND_IN, name)
        path = folder / place
        path.parent.mkdir(parents=True, exist_ok=True)
        text = file.read_text(encoding="utf-8").replace(STAND_IN, name)
        path.write_text(text, encoding="utf-8")
        written.append(path)
    return written
