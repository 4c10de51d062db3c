#!/usr/bin/env bash
# run_instance.sh v1 CATEGORY ONNX SPEC RESULTS TIMEOUT
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
# Starting Python and writing the answer take time that counts: stop a little early.
limit=$(awk -v limit="$6" 'BEGIN { print (limit > 4) ? limit - 2 : limit / 2 }')
case $4 in *.json) asked=(verify "$4") ;; *) asked=(query "$3" "$4") ;; esac
exec "${PYTHON:-python3}" -m verifier "${asked[@]}" --result "$5" --timeout "$limit"
