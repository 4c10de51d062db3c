#!/usr/bin/env bash
# prepare_instance.sh v1 CATEGORY ONNX SPEC: the tool reads the specification as it is.
[ "$1" = v1 ]
