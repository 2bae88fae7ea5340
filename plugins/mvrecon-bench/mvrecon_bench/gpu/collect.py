"""Collect the results of several runs of `learn.py` in one file.

python -m mvrecon_bench.gpu.collect FOLDER OUT.json
"""

import argparse
import json
from pathlib import Path


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    runs = {}
    for path in sorted(options.folder.glob("*/*.json")):
        facts = json.loads(path.read_text())
        profile = facts.pop("profile", None)
        runs[path.parent.name] = facts | (profile if isinstance(profile, dict) else {})
    options.out.write_text(json.dumps(runs, indent=1) + "\n")


if __name__ == "__main__":
    main()
