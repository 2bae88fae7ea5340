"""One of the other processes of a training: `python -m mvrecon.engine.other_process RUN`."""

import os
import sys
import threading
from pathlib import Path

from mvrecon.config.plugins import import_plugins
from mvrecon.config.quiet import silence_libraries
from mvrecon.engine import fit, run_folder


def main(folder: Path) -> None:
    """Train every method of a run beside its first process, and end when that one does."""
    threading.Thread(target=_end_with_the_first, daemon=True).start()
    silence_libraries()
    settings = run_folder.read_settings(folder)
    import_plugins(settings["plugins"])
    fit.fit_all(settings, fit.build_data(settings), folder)


def _end_with_the_first() -> None:
    os.read(0, 1)  # the standard input ends when the first process does, however that ends
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
