#!/usr/bin/env bash
# run_instance.sh v1 CATEGORY ONNX SPEC RESULTS TIMEOUT
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
folder=$(cd "$(dirname "$0")" && pwd) # of this script
category=$2 onnx=$3 spec=$4 results=$5 timeout=$6

# Call NAME here, and write its answer to "$results": sat, unsat, unknown, timeout or error in the
# first line; after sat, the witness. It must end within $timeout seconds, with status 0.
echo "NAME in $folder is asked about $spec ($category, $onnx, $timeout s)"
echo unknown > "$results"
