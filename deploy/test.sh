#!/usr/bin/env bash
# Installs what is missing, builds and passes every test. Extra arguments go to ctest (-R NAME, -j N ...).
set -euo pipefail
cd "$(dirname "$0")/.."

deploy/build.sh release >&2
ctest --preset release -j "$(nproc)" "$@"
