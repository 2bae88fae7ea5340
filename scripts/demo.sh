#!/usr/bin/env bash
# Trains the quickstart, with right cameras and with three wrong ones, prints both tables of results, and says how to look at the
# runs. Arguments go to mvrecon-train.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh

bin=.venv/bin
if [ -d .venv/Scripts ]; then bin=.venv/Scripts; fi # Windows
for experiment in quickstart quickstart_rig_errors; do
    "$bin/mvrecon-train" experiment="$experiment" "$@"
done

cat <<TEXT

Look at the runs:  $bin/tensorboard --logdir outputs --samples_per_plugin images=200
and open http://localhost:6006 in a browser.
TEXT
