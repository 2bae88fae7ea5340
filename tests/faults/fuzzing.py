"""Fuzz every reader here and write what came of it as JSON: python -m tests.faults.fuzzing SEED
COUNT OUT.
"""

import faulthandler
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from random import Random

from tests.faults.fuzz import mutations, tally
from tests.faults.samples import CHECKED, samples

#: Bytes that may be added to what the process uses once all is imported; seconds for all cases of a
#: reader.
MEMORY, SECONDS = 2 * 2**30, 60


def limit() -> None:
    """A reader that asks for much memory fails, one that hangs ends this process."""
    if sys.platform == "linux":
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))


def main(seed: int, count: int, out: Path) -> None:
    """Give `count` damaged files to every reader."""
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        table = samples(Path(folder))
        limit()
        for name, (read, data, wrap, suffix) in table.items():
            whole = data if name in CHECKED else None
            found[name] = {"inputs": 0, "failures": ["the process ended here"]}
            out.write_text(json.dumps(found))
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            cases = (wrap(case) for case in mutations(data, Random(f"{seed} {name}"), count))
            found[name] = asdict(tally(read, cases, Path(folder) / f"damaged{suffix}", whole))
        faulthandler.cancel_dump_traceback_later()
    out.write_text(json.dumps(found))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
