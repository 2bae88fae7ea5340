#!/usr/bin/env bash
# Writes lock.txt: every package of every extra at the version of constraints.txt, with the hashes of all its files, so
# that one lock serves every platform. It names no index; `pip install --require-hashes -r lock.txt` takes pip's own.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh dev

.venv/bin/python -m pip --disable-pip-version-check --no-input install --quiet "uv==0.13.9"
{
    echo "# By scripts/lock.sh. To install: pip install --require-hashes -r lock.txt && pip install --no-deps ."
    .venv/bin/uv pip compile pyproject.toml --all-extras --constraint constraints.txt \
        --universal --python-version 3.11 --generate-hashes --no-emit-package mvrecon \
        --no-header --no-annotate --no-emit-index-url --no-emit-find-links --quiet
} >lock.txt.part
mv lock.txt.part lock.txt
