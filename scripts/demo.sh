#!/usr/bin/env bash
# Trains the quickstart, prints its table and those where all cameras are right and where three are wrong, and says how to look at
# the run. Arguments go to mvrecon-train.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash scripts/setup.sh

bin=.venv/bin
if [ -d .venv/Scripts ]; then bin=.venv/Scripts; fi # Windows
run=outputs/quickstart/$(date +%Y-%m-%d_%H-%M-%S)
"$bin/mvrecon-train" experiment=quickstart hydra.run.dir="$run" "$@"
"$bin/mvrecon-eval" checkpoint="$run" acquisition=ideal name=quickstart_right
"$bin/mvrecon-eval" checkpoint="$run" experiment=quickstart_rig_errors

cat <<TEXT

Look at the run:  $bin/tensorboard --logdir outputs --samples_per_plugin images=200
and open http://localhost:6006 in a browser.
TEXT
