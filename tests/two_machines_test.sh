#!/usr/bin/env bash
# A cluster on two machines: server and worker in two network namespaces that a virtual cable joins, by the commands of
# deploy/README.md. Skipped (77) where namespaces may not be made.
# usage: two_machines_test.sh BIN_FOLDER
set -uo pipefail
bin=$1
work=$(mktemp -d)
a=tessera-a-$$ b=tessera-b-$$
trap 'kill $(jobs -p) 2>/dev/null; ip netns del $a 2>/dev/null; ip netns del $b 2>/dev/null; rm -rf "$work"' EXIT

if ! ip netns add "$a" 2>/dev/null || ! ip netns add "$b" 2>/dev/null; then
    echo "skipped: no network namespaces here (they need root)"
    exit 77
fi
fail() { echo "FAILED: $*"; cat "$work"/*.log; exit 1; }

ip link add a0 netns "$a" type veth peer name b0 netns "$b" || fail "no cable"
for side in "$a a0 10.73.1.1" "$b b0 10.73.1.2"; do
    read -r machine device address <<<"$side"
    ip -n "$machine" addr add "$address/24" dev "$device"
    ip -n "$machine" link set "$device" up
    ip -n "$machine" link set lo up
done
on() { local machine=$1; shift; ip netns exec "$machine" timeout 60 "$@"; }

"$bin/tessera" keys "$work/keys" >"$work/keys.log" || fail "keys"
mkfifo "$work/greeting"
on "$a" "$bin/tessera-server" --listen 10.73.1.1:7411 --keys "$work/keys/server" >"$work/greeting" 2>"$work/server.log" &
read -r _ <"$work/greeting" || fail "the server does not listen"
on "$b" "$bin/tessera-worker" --server 10.73.1.1:7411 --keys "$work/keys/worker" 2>"$work/worker.log" &
on "$a" "$bin/tessera" render cornell -o "$work/picture.png" --size 64x48 --server 10.73.1.1:7411 --keys "$work/keys/editor" \
    2>"$work/render.log" || fail "render"
on "$b" "$bin/tessera" status --server 10.73.1.1:7411 --keys "$work/keys/viewer" >"$work/status" || fail "status"
grep -q '10.73.1.2:' "$work/status" || fail "no worker of the other machine: $(cat "$work/status")"
[[ -s $work/picture.png ]] || fail "no picture"
echo "all good"
