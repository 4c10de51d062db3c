#!/usr/bin/env bash
# install_tool.sh v1: the tool comes with the package; nothing is left to install.
[ "$1" = v1 ]
