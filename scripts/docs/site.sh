#!/usr/bin/env bash
# Builds the documentation's site into build/site; a broken link or an unknown name ends it with an error.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
bash scripts/setup.sh docs

bin=.venv/bin
if [ -d .venv/Scripts ]; then bin=.venv/Scripts; fi
"$bin/python" -m scripts.docs.site_pages build/pages
"$bin/zensical" build --clean --strict
echo "Open build/site/index.html in a browser; with search: $bin/python -m http.server --directory build/site"
