#!/usr/bin/env bash
# Run the checks on the machine with the GPU, in the root of a checkout: bash tools/gpu/check.sh [SECONDS] [STEP ...]
#
# Figures go to $OUT/figures.json, what was printed to $OUT/log.txt, both as they come. Every step has a limit of its own
# and runs in a process of its own: one that fails or hangs stops no other. Without STEPs: all, the most telling first.
set -u
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
export SITE=${SITE:-/tmp/site} OUT=${OUT:-/tmp/check} WARP_CACHE_PATH=${WARP_CACHE_PATH:-/tmp/warp-cache}
export PYTHONUNBUFFERED=1 PYTHONPATH=$SITE:$PWD:$here MPLBACKEND=Agg
mkdir -p "$OUT"
exec python3 "$here/check.py" all "${@:2}" --out "$OUT" --budget "${1:-330}" 2>&1
