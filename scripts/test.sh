#!/usr/bin/env bash
# Every check of the project: style, types, layers, tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh dev

export PATH="$PWD/.venv/bin:$PWD/.venv/Scripts:$PATH" OMP_NUM_THREADS=1 # Scripts: on Windows
ruff check .
ruff format --check .
python -m mvrecon.apps.warmup # else both of pytest's workers compile the same kernels
python -m pytest -n 2 --dist=worksteal "$@"
