"""Write a row for each run of `learn.py` to a CSV file: its steps, without the list of kernels.

python -m mvrecon_bench.gpu.collect FOLDER OUT.csv
"""

import argparse
import json
from pathlib import Path

from mvrecon.core.files.runs import write_rows


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    rows = []
    for path in sorted(options.folder.glob("**/learn_*.json")):
        facts = json.loads(path.read_text())
        facts |= facts.pop("profile", {})
        numbers = {key: value for key, value in facts.items() if isinstance(value, int | float)}
        rows.append({"run": path.stem.removeprefix("learn_"), **numbers})
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
