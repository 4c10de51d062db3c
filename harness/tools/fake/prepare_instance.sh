#!/usr/bin/env bash
# prepare_instance.sh v1 CATEGORY ONNX SPEC
[ "$1" = v1 ] || exit 1
# Without instructions there is nothing to do, and no Python to start.
[ -n "${FAKE_ANSWERS:-}${FAKE_ANSWER:-}" ] || exit 0
exec "${PYTHON:-python3}" -IS "$(dirname "$0")/fake.py" prepare "$@"
