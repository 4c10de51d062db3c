#!/usr/bin/env bash
# run_instance.sh v1 CATEGORY ONNX SPEC RESULTS TIMEOUT
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
# It reads closed loops only.
case $4 in *.vnnlib | *.vnnlib.gz) echo "reference does not read VNN-LIB"; echo unknown > "$5"; exit 0;; esac
# Starting Python and writing the answer take time that counts: stop a little early.
limit=$(awk -v limit="$6" 'BEGIN { print (limit > 4) ? limit - 2 : limit / 2 }')
exec "${PYTHON:-python3}" -m verifier verify "$4" --result "$5" --timeout "$limit"
