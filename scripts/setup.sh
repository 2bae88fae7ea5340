#!/usr/bin/env bash
# Makes .venv with the versions of constraints.txt: `bash scripts/setup.sh [extras]`, extras such as "io" or "dev".
# A second run with nothing changed returns at once. PYTHON=... says which Python; else the first that fits.
set -euo pipefail
shopt -s nullglob
cd "$(dirname "${BASH_SOURCE[0]}")/.."

extras=${1:-io}
state=$(cat <(pwd) pyproject.toml constraints.txt scripts/setup.sh plugins/*/pyproject.toml | cksum)
stamps=(".venv/installed-$extras")
if [ "$extras" = io ]; then stamps+=(.venv/installed-dev .venv/installed-docs); fi # both have io
for stamp in "${stamps[@]}"; do
    if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$state" ]; then exit 0; fi
done

supported='import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'
for python in ${PYTHON:-python3.11 python3.12 python3.13 python3 python} none; do
    if "$python" -c "$supported" 2>/dev/null; then break; fi
done
if [ "$python" = none ]; then
    echo "mvrecon needs Python 3.11, 3.12 or 3.13 with its venv module; found $("${PYTHON:-python3}" --version 2>&1 || true)." >&2
    exit 1
fi

echo "Setting up .venv with $("$python" --version), once; this takes some minutes ..."
for stamp in .venv/installed-*; do # of other versions
    if [ -f "$stamp" ] && [ "$(cat "$stamp")" != "$state" ]; then rm "$stamp"; fi
done
"$python" -m venv .venv
bin=.venv/bin
if [ -d .venv/Scripts ]; then bin=.venv/Scripts; fi # Windows
install() { "$bin/python" -m pip --disable-pip-version-check --no-input install --quiet -c constraints.txt "$@"; }

# torch first and alone: it is by far the largest, and there are several builds of one version.
torch=$(grep '^torch==' constraints.txt)
default="$torch, the build of pip's package index; on Linux it has CUDA: several GB to download"
if [[ $(nvidia-smi -L 2>/dev/null) == *GPU* ]]; then
    echo "There is an NVIDIA GPU: $default."
    install "$torch"
else
    echo "There is no NVIDIA GPU: $torch+cpu, 0.2 GB to download, 0.8 GB on the disk, if pip's settings lead to it ..."
    if ! install "$torch+cpu" 2>/dev/null; then
        echo "They do not: $default."
        echo "(For the small one: PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu bash scripts/setup.sh)"
        install "$torch"
    fi
fi
install -e ".[$extras]"
for plugin in plugins/*/pyproject.toml; do install -e "$(dirname "$plugin")"; done
echo "$state" >".venv/installed-$extras"
