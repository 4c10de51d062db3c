#!/usr/bin/env bash
# prepare_instance.sh v1 CATEGORY ONNX SPEC: before the clock starts, at most 600 s. Convert files here,
# into the working folder; run_instance.sh finds them there. It must end with status 0.
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
