#!/usr/bin/env bash
# A scene whose triangles all move, and ever more workers behind one thin uplink: does the picture come slower with more
# of them, as in Wald's thesis (2004, table 9.4), where every update goes out once per worker? Server and viewer in one
# network namespace, workers in another, a cable of a limited rate between them. Workers take every update as real ones
# do, and answer tiles with made-up pixels after a drawn time, so that two cores can play sixteen machines.
# Prints a table, and fails when the frame rate falls from the first number of workers to the last; with VERDICT=bytes,
# which holds on a machine of any speed, when half as many bytes more go out for a frame.
# usage: uplink.sh BIN_FOLDER [options of `tessera bench cluster`, such as --shape-error 0.001]
# SCENE=museum:4096 RATE=100mbit RELAYS=auto (on, off) WORKERS="2 4 8 16" THREADS=2 TILE_MS=0.74 SECONDS_EACH=10 VIEWS=32 override.
# Needs root; skipped (77) where namespaces may not be made.
set -uo pipefail
bin=$1
shift
scene=${SCENE:-museum:4096} rate=${RATE:-100mbit} relays=${RELAYS:-auto} threads=${THREADS:-2} tile=${TILE_MS:-0.74} time=${SECONDS_EACH:-10} views=${VIEWS:-32}
read -ra counts <<<"${WORKERS:-2 4 8 16}"
work=$(mktemp -d)
a=tessera-a-$$ b=tessera-b-$$
trap 'kill $(jobs -p) 2>/dev/null; wait; ip netns del $a 2>/dev/null; ip netns del $b 2>/dev/null; rm -rf "$work"' EXIT

if ! ip netns add "$a" 2>/dev/null || ! ip netns add "$b" 2>/dev/null; then
    echo "skipped: no network namespaces here (they need root)"
    exit 77
fi
fail() { echo "FAILED: $*"; cat "$work"/*.log; exit 1; }

ip link add a0 netns "$a" type veth peer name b0 netns "$b" || fail "no cable"
for side in "$a a0 10.74.1.1" "$b b0 10.74.1.2"; do
    read -r machine device address <<<"$side"
    ip -n "$machine" addr add "$address/24" dev "$device"
    ip -n "$machine" link set "$device" up
    ip -n "$machine" link set lo up
done
if ! ip netns exec "$a" tc qdisc add dev a0 root tbf rate "$rate" burst 32kbit latency 50ms 2>"$work/tc.log"; then
    echo "skipped: no token bucket filter here: $(cat "$work/tc.log")"
    exit 77
fi
on() { local machine=$1; shift; ip netns exec "$machine" "$@"; }

"$bin/tessera" keys "$work/keys" >"$work/keys.log" || fail "keys"
keys=(--keys "$work/keys")
echo "$scene, 640x480, uplink of $rate, relays $relays, tiles of $tile ms, workers of $threads threads"
printf '%8s %9s %22s %20s %17s\n' workers frames/s "frame p50 / p95 ms" "kB/frame on uplink" "of them / worker"
first= last=
for count in "${counts[@]}"; do
    mkfifo "$work/greeting"
    # Not by on(): the number must be the program's own.
    ip netns exec "$a" "$bin/tessera-server" --listen 10.74.1.1:7411 --keys "$work/keys/server" --log warning --relays "$relays" \
        >"$work/greeting" 2>"$work/server.log" &
    server=$!
    read -r _ <"$work/greeting" || fail "the server does not listen"
    rm "$work/greeting"
    ip netns exec "$b" "$bin/tessera" bench cluster "$scene" --synthetic --relays --server 10.74.1.1:7411 "${keys[@]}" \
        --workers "$count" --viewers 0 --threads "$threads" --tile-ms "$tile" --seconds 3600 >"$work/workers.log" 2>&1 &
    workers=$!
    until on "$a" "$bin/tessera" status --server 10.74.1.1:7411 --keys "$work/keys/viewer" --json 2>/dev/null |
        python3 -c "import json, sys; sys.exit(len(json.load(sys.stdin)['workers']) < $count)"; do
        kill -0 $workers 2>/dev/null || fail "workers"
    done
    before=$(on "$a" cat /sys/class/net/a0/statistics/tx_bytes)
    on "$a" "$bin/tessera" bench cluster "$scene" --synthetic --server 10.74.1.1:7411 "${keys[@]}" --workers 0 \
        --viewers 1 --in-flight 2 --size 640x480 --animate 25 --views "$views" --seconds "$time" --json "$work/result.json" \
        "$@" >"$work/viewer.log" 2>&1 || fail "viewer"
    sent=$(($(on "$a" cat /sys/class/net/a0/statistics/tx_bytes) - before))
    last=$(python3 - "$work/result.json" "$count" "$sent" "$views" "${VERDICT:-frames}" <<'PY'
import json, sys
row = json.load(open(sys.argv[1]))["results"][0]
count, sent, views = map(int, sys.argv[2:5])
frames = row["frames"] + 2 * views  # each view is rendered twice before
median, slow = (1e3 * (row["latency_final_s"][q] or 0) for q in ("p50", "p95"))  # of no frames none
print(f"{count:8} {row['frames_per_s']:9.2f} {median:13.0f} / {slow:6.0f} "
      f"{1e-3 * sent / frames:20.0f} {1e-3 * sent / frames / count:17.1f}", file=sys.stderr)
print(row["frames_per_s"] if sys.argv[5] == "frames" else frames / sent)
PY
    ) || fail "no result"
    first=${first:-$last}
    kill $workers $server
    wait $workers $server 2>/dev/null
done
if [[ ${VERDICT:-frames} == bytes ]]; then
    python3 -c "import sys; sys.exit(1.5 * $last < $first)" || fail "from $first frames a byte to $last"
else
    python3 -c "import sys; sys.exit($last < 0.98 * $first)" || fail "from $first frames a second to $last"
fi
