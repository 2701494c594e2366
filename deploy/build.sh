#!/usr/bin/env bash
# Installs what is missing, configures and builds a CMake preset (default: release, into build/).
# usage: deploy/build.sh [PRESET] [cmake configure options...]
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${1:-release}
shift || true

deploy/install.sh
cmake --preset "$preset" "$@" >/dev/null
cmake --build --preset "$preset"
