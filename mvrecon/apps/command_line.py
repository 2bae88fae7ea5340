"""Command lines of the apps without Hydra, and the last line of every `--help`."""

import argparse

from mvrecon import __version__

#: The last line of every `--help`.
DOCUMENTATION = (
    "Documentation: docs/README.md in the repository lists all pages; docs/start.md is the first.\n"
)


def command_line(command: str, docstring: str | None) -> argparse.ArgumentParser:
    """A parser with `--version`, and a `--help` that has examples before the options and ends with
    where the documentation is.

    Args:
        command: name of the command, such as mvrecon-view.
        docstring: docstring of its module: the name, a colon, what the command does, and indented
            examples.
    """
    about = (docstring or "").partition("`: ")[2]
    made = argparse.ArgumentParser(
        prog=command,
        description=about[:1].upper() + about[1:],
        epilog=DOCUMENTATION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=False,
    )
    made.add_argument("-h", "--help", action="help", help="Prints this help.")
    made.add_argument(
        "--version", action="version", version=f"mvrecon {__version__}", help="Prints the version."
    )
    return made
