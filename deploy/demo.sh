#!/usr/bin/env bash
# Installs what is missing, builds, and renders two generated scenes on the embedded cluster:
# a server and a worker on this machine, started and ended by the client.
set -euo pipefail
cd "$(dirname "$0")/.."

deploy/build.sh release >&2
mkdir -p out
build/bin/tessera render cornell -o out/cornell.png --size 512x512
build/bin/tessera render office -o out/office.png --size 960x540 --passes 4
