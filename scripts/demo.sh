#!/usr/bin/env bash
# Trains the quickstart, prints its table of results, and says how to look at the run. Arguments go to mvrecon-train.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh

bin=.venv/bin
if [ -d .venv/Scripts ]; then bin=.venv/Scripts; fi # Windows
"$bin/mvrecon-train" experiment=quickstart "$@"

cat <<TEXT

Look at the runs:  $bin/tensorboard --logdir outputs --samples_per_plugin images=200
and open http://localhost:6006 in a browser.
TEXT
