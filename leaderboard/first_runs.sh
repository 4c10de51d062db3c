#!/usr/bin/env bash
# Makes the runs of the first leaderboard: every shipped tool on `quick` and on a sample of every other
# category, one run a tool, in leaderboard/submissions/.
#
#     leaderboard/first_runs.sh [EVERY [TOOL...]]
#
# EVERY: of the other categories each EVERY-th instance is run (default: 40; 0: `quick` alone); TOOL:
# names of tools that ship, or folders (default: reference simulate). A run that is there is
# continued. In the environment, PYTHON: an interpreter that has the package (default: python3);
# TIMEOUT: seconds for every instance, instead of its own.
set -euo pipefail
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
cd "$(dirname "$0")/.."
python=${PYTHON:-python3} every=${1:-40}
shift $(($# > 0))
[ $# -gt 0 ] || set -- reference simulate

chosen=(--category quick)
[ -z "${TIMEOUT:-}" ] || chosen+=(--timeout "$TIMEOUT")
if [ "$every" -gt 0 ]; then
    for list in benchmarks/*/instances.csv; do
        [ "$list" != benchmarks/quick/instances.csv ] || continue
        # An instance's ID is the name of its specification without the ending.
        while read -r id; do chosen+=(--instance "$id"); done < <(
            awk -F, -v every="$every" 'NR % every == 1 || every == 1 {
                n = split($2, parts, "/"); sub(/\.[^.]*$/, "", parts[n]); print parts[n]
            }' "$list")
    done
fi
for tool; do
    out=leaderboard/submissions/$(basename "$tool")
    "$python" -m harness run --tool "$tool" "${chosen[@]}" --out "$out" --resume
done
