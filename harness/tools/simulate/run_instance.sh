#!/usr/bin/env bash
# run_instance.sh v1 CATEGORY ONNX SPEC RESULTS TIMEOUT
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
# It reads closed loops only.
case $4 in *.vnnlib | *.vnnlib.gz) echo "simulate does not read VNN-LIB"; echo unknown > "$5"; exit 0;; esac
exec "${PYTHON:-python3}" -m harness.falsifier "$4" "$5" "$6"
