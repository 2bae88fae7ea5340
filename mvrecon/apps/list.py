"""`mvrecon-list`: lists the parts that a configuration can name, with options, units and sources.

Examples:

    mvrecon-list
    mvrecon-list projector drr
    mvrecon-list plugins=[my_parts] head
    mvrecon-list --new-plugin my_plugin

Names are listed without importing anything. Parts whose options are shown are imported, and a
broken one is shown with the reason. plugins=[my_parts] imports modules that are not installed, as
in the other apps.
"""

import argparse
import keyword
import sys
from collections.abc import Sequence
from pathlib import Path

from mvrecon.apps.command_line import command_line
from mvrecon.apps.settings import SECTIONS
from mvrecon.core.parts import LISTED, METRICS, Part, describe, describe_section
from mvrecon.core.registry import hint, import_plugins

#: The project; `my_plugin` in paths and texts stands for its name, and files end in `.txt`, so that
#: nothing takes them for mvrecon's own.
TEMPLATE = Path(__file__).parents[1] / "template"
STAND_IN = "my_plugin"


def new_plugin(name: str, parent: Path) -> list[Path]:
    """Write a pip-installable project into the new folder `parent / name`; returns its files.

    Raises:
        ValueError: not a valid name of a Python package, or mvrecon's own.
        FileExistsError: the folder exists.
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


SETTING = "setting"


def listed(kind: str | None = None) -> list[Part]:
    """Describe the parts of one kind, or of all, or the settings that are no parts."""
    if kind == SETTING:
        return [describe_section(name, section) for name, section in SECTIONS.items()]
    kinds = [kind] if kind else list(LISTED)
    return [describe(k, name) for k in kinds for name in LISTED[k].names()]


def overview() -> None:
    """Write each kind with the names of its parts to the console."""
    from rich.console import Console
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for kind, registry in {**LISTED, SETTING: None}.items():
        names = list(SECTIONS) if registry is None else registry.names()
        if names:
            table.add_row(kind, ", ".join(names))
    console = Console(highlight=False)
    console.print(table)
    console.print("mvrecon-list KIND [NAME] shows the options of a kind or part, and their source.")


def show(parts: Sequence[Part]) -> None:
    """Write the parts to the console, one block each under their kind."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console, table, kind = Console(highlight=False), Table.grid(padding=(0, 2)), ""
    for part in parts:
        if part.kind != kind:
            kind = part.kind
            table.add_row(Text(f"\n{kind}", style="bold"))
        rest = Text(part.summary)
        if part.error:
            rest.append(f"broken: {part.error}", style="red")
        elif part.kind == METRICS.kind:
            from mvrecon.report.metrics import declared  # imports torch

            metric = declared(part.name)
            better = "higher" if metric.higher_is_better else "lower"
            rest.append(f"\n  unit {metric.unit or 'not declared'}, {better} is better", "dim")
        for option, what in part.options.items():
            rest.append(f"\n  {what.line(option)}", style="dim")
        rest.append(f"\n{part.origin}" if part.origin else "", style="dim")
        table.add_row(Text(f"  {part.name}", style="cyan"), rest)
    console.print(table)


def report(parts: Sequence[Part]) -> int:
    """Write one line for each part that was imported; the exit status, 1 where one is broken."""
    lines = [
        f"{part.kind:<15} {part.name:<22} {f'broken: {part.error}' if part.error else part.origin}"
        for part in parts
    ]
    broken = sum(bool(part.error) for part in parts)
    lines.append(f"{len(parts)} parts imported, {broken} of them broken")
    sys.stdout.write("\n".join(lines) + "\n")
    return int(broken > 0)


def parser() -> argparse.ArgumentParser:
    """The command line of `mvrecon-list`, without `plugins=`."""
    made = command_line("mvrecon-list", __doc__)
    made.add_argument(
        "kind",
        nargs="?",
        choices=sorted({*LISTED, SETTING}),
        help="Shows all parts of one kind with their options; without it, the names of all kinds.",
    )
    made.add_argument("name", nargs="?", help="Shows a single part of the kind.")
    made.add_argument(
        "--check",
        action="store_true",
        help="Imports every part, and reports those that fail, with the reason.",
    )
    made.add_argument(
        "--new-plugin",
        metavar="NAME",
        help="Writes a plugin project with a part of every kind into a new folder NAME.",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """The console script; its exit status is 1 if a part that was checked is broken."""
    words = sys.argv[1:] if arguments is None else arguments
    plugins = [word for word in words if word.lstrip("+").startswith("plugins=")]
    line = parser()
    options = line.parse_args([word for word in words if word not in plugins])
    if plugins:
        import yaml

        from mvrecon.apps.config.errors import one_line  # imports Hydra

        sys.path.append(str(Path.cwd()))  # last: nothing there takes another module's place
        with one_line("mvrecon-list"):
            for word in plugins:
                import_plugins(yaml.safe_load(word.partition("=")[2]))
    if name := options.new_plugin:
        try:
            files = new_plugin(name, Path.cwd())
        except (ValueError, OSError) as error:
            line.error(str(error))
        sys.stdout.write(
            f"{len(files)} files in {name}; next: pip install -e {name} pytest; pytest {name}\n"
        )
        return 0
    if not options.kind and not options.check:
        overview()
        return 0
    from mvrecon.apps.config.errors import one_line  # imports Hydra

    with one_line("mvrecon-list"):  # imports the parts
        parts = listed(options.kind)
    if name := options.name:
        known = {part.name for part in parts}
        parts = [part for part in parts if part.name == name]
        if not parts:
            line.error(f"Unknown {options.kind} {name!r}{hint(name, known)}")
    if options.check:
        return report(parts)
    if not parts:
        line.exit(message=f"No {options.kind} is registered; plugins can add some.\n")
    show(parts)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
