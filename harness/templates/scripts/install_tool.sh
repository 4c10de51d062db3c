#!/usr/bin/env bash
# install_tool.sh v1: once, before the first instance of a run, at most an hour. It may find the
# tool there already. Remove this file if there is nothing to install.
set -eu
[ "$1" = v1 ] || { echo "unknown interface version $1" >&2; exit 1; }
