#!/usr/bin/env bash
# The command line as people and scripts use it: files appear, statistics are valid, and everything that goes wrong
# says so in a sentence, with a failing exit status and no process left behind.
# usage: cli_test.sh BIN_FOLDER
set -uo pipefail
bin=$1
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null; rm -rf "$work"' EXIT
failures=0

fail() { echo "FAILED: $*"; failures=$((failures + 1)); }

# expect_ok WHAT COMMAND...
expect_ok() {
    local what=$1; shift
    "$@" >"$work/out" 2>"$work/err" || { fail "$what: exit status $?"; cat "$work/err"; }
}

# expect_error PATTERN COMMAND...: fails, and says something that matches
expect_error() {
    local pattern=$1; shift
    if "$@" >"$work/out" 2>"$work/err"; then fail "succeeded: $*"; return; fi
    grep -qiE -- "$pattern" "$work/err" || { fail "no '$pattern' in the message of: $*"; cat "$work/err"; }
}

# children_of PID: its server and worker, once both run
children_of() {
    local children=
    while kill -0 "$1" 2>/dev/null && [[ $(wc -w <<<"$children") -lt 2 ]]; do children=$(pgrep -P "$1"); done
    echo $children
}

tessera() { timeout 60 "$bin/tessera" "$@"; }

expect_ok "list" tessera scene --list
grep -q '^cornell' "$work/out" || fail "scene --list misses cornell"
expect_ok "generate" tessera scene cornell -o "$work/cornell.glb"
expect_ok "render" tessera render "$work/cornell.glb" -o "$work/a.exr" --size 64x48 --stats "$work/stats.json" --aov albedo,normal,depth,direct
for field in load_seconds build_seconds render_seconds passes rays error_estimate plan workers; do
    grep -q "\"$field\"" "$work/stats.json" || fail "stats miss $field"
done
for aov in albedo normal depth direct; do [[ -s $work/a.$aov.exr ]] || fail "no $aov"; done
expect_ok "generated name, equals signs" tessera render cornell -o "$work/b.exr" --size=64x48 --workers=2 --threads=1
expect_ok "compare" tessera compare "$work/a.exr" "$work/b.exr" --json
grep -q '"identical": true' "$work/out" || fail "file and generated scene differ"
expect_ok "png" tessera render cornell -o "$work/c.png" --size 40x30 --integrator path --passes 2 --tone filmic
expect_ok "time limit" tessera render cornell -o "$work/d.png" --size 40x30 --time 0.2
animate() { tessera render museum:64 --animate 0:1:2 -o "$work/fly_%02d.png" --size 40x30; }
expect_ok "sequence" animate
cp "$work/fly_01.png" "$work/whole.png"
cmp -s "$work/fly_00.png" "$work/fly_01.png" && fail "nothing moves in a sequence"
truncate -s 100 "$work/fly_01.png"
expect_ok "sequence that goes on" animate
grep -q "1 pictures in .* 1 were there already" "$work/err" || fail "the sequence does not go on where it stopped"
cmp -s "$work/fly_01.png" "$work/whole.png" || fail "a picture of a sequence differs the second time"
expect_error "needs one %d" tessera render museum:64 --animate 0:1:2 -o "$work/fly.png"
expect_error "FROM:TO:FPS" tessera render museum:64 --animate 0:1 -o "$work/fly_%d.png"
expect_error "nothing in it moves" tessera render cornell --animate 0:1:2 -o "$work/fly_%d.png"
printf 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n' >"$work/dark.obj"
expect_ok "no light, no camera" tessera render "$work/dark.obj" -o "$work/dark.png" --size 20x20
grep -q "no light" "$work/err" || fail "does not say that there is no light"
grep -q "no camera" "$work/err" || fail "does not say that there is no camera"

expect_ok "bench" tessera bench trace cornell --quick --json "$work/bench.json"
for field in ours_mrays_per_s embree_mrays_per_s ratio mismatches bytes_per_triangle; do
    grep -q "\"$field\"" "$work/bench.json" || fail "bench misses $field"
done
expect_ok "bench help" tessera bench --help
grep -q stability "$work/out" || fail "bench does not tell of its benchmarks"
expect_ok "bench quality" tessera bench quality cornell --quick --size 32x24 --reference-time 0.1 -o "$work/quality"
for file in quality.csv quality.json cornell.svg "cornell.refined igi.png" cornell.path.png; do
    [[ -s "$work/quality/$file" ]] || fail "bench quality does not write $file"
done
expect_error "no-such-scene" tessera bench trace no-such-scene
expect_error "no-such-scene" tessera bench quality no-such-scene
expect_error "subcommand" tessera bench nonsense

expect_error "missing.glb" tessera render "$work/missing.glb" -o "$work/x.png"
printf 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n' >"$work/broken.obj"
expect_error "broken.obj:4" tessera render "$work/broken.obj" -o "$work/x.png"
printf 'ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n1 oops 0\n' >"$work/broken.ply"
expect_error "broken.ply:9" tessera render "$work/broken.ply" -o "$work/x.png"
echo '{"asset": {"version": "2.0"' >"$work/broken.gltf"
expect_error "broken.gltf" tessera render "$work/broken.gltf" -o "$work/x.png"
echo 'no picture' >"$work/broken.exr"
expect_error "broken.exr" tessera compare "$work/a.exr" "$work/broken.exr"
expect_error "size" tessera render cornell -o "$work/x.png" --size 0x10
expect_error "size" tessera render cornell -o "$work/x.png" --size 99999x10
expect_error "vpls" tessera render cornell -o "$work/x.png" --vpls 0
expect_error "interleave" tessera render cornell -o "$work/x.png" --interleave 4
expect_error "x.nonsense" tessera render cornell -o "$work/x.nonsense"
expect_error "up" tessera render cornell -o "$work/x.png" --eye 0,1,0 --at 0,0,0
expect_error "no such camera" tessera render cornell -o "$work/x.png" --camera none
expect_error "cannot reach" tessera status --server 127.0.0.1:1
expect_error "cannot reach" tessera render cornell -o "$work/x.png" --server 127.0.0.1:1
expect_error "nowhere" tessera status --server nowhere
expect_error "output" tessera render cornell

# A server of one's own: no workers at first, a port that is taken, status, a wrong token.
export TESSERA_TOKEN=secret
mkfifo "$work/greeting" "$work/notes"
"$bin/tessera-server" cornell --listen 127.0.0.1:0 >"$work/greeting" 2>"$work/server.log" &
server=$!
read -r _ _ address <"$work/greeting"
expect_error "in use" timeout 20 "$bin/tessera-server" --listen "$address"
TESSERA_TOKEN=guess expect_error "token" tessera status --server "$address"
expect_ok "status" tessera status --server "$address" --json
grep -q '"workers": \[\]' "$work/out" || fail "status shows workers that are not there"
tessera render cornell -o "$work/late.png" --size 64x48 --server "$address" 2>"$work/notes" &
client=$!
exec 3<"$work/notes"  # stays open, so that the client may go on writing
grep -m 1 -q "waiting" <&3 || fail "does not say that it waits for workers"
"$bin/tessera-worker" --server "$address" --threads 1 2>"$work/worker.log" &
wait $client || fail "render that waited for a worker"

# The server's own scene, changed by scripts and looked at without a screen.
edit() { tessera edit --server "$address" "$@"; }
expect_ok "edit list" edit list --json
grep -q '"name": "short block"' "$work/out" || fail "edit list misses the short block"
expect_ok "edit move" edit move "short block" 0.1,0,0.2
expect_ok "edit set" edit --scene cornell set material white base_color=0.5,0.6,0.7 roughness=0.5
edit list >"$work/out"
grep -q 'short block *at 0.1,0,0.2' "$work/out" || fail "the block has not moved"
grep -q 'white *base_color=0.5,0.6,0.7 metallic=0 roughness=0.5' "$work/out" || fail "white has not changed"
echo '[{"edits": [{"create": "third", "object": "short block"}]}, {"time": 0.1, "edits": [{"delete": "third"}]}]' >"$work/edits.json"
expect_ok "edit play" edit play "$work/edits.json"
expect_ok "edit apply" edit apply '{"create material": "blue", "like": "white", "to": {"base_color": [0, 0, 1]}}' \
    '{"create object": "blue block", "like": "short block", "materials": ["blue"]}' '{"create": "new", "object": "blue block"}' \
    '{"set": "environment", "to": {"radiance": [0.1, 0.2, 0.3]}}'
edit list >"$work/out"
grep -q "new *at 0,0,0 *object 'blue block'" "$work/out" || fail "there is no blue block"
grep -q 'environment *radiance=0.1,0.2,0.3' "$work/out" || fail "there is no light from outside"
expect_error "in use" edit apply '{"delete object": "blue block"}'
expect_error "nobody" edit move nobody 0,0,0
expect_error "no material 'nobody'" edit set material nobody roughness=1
expect_error "roughness must be" edit set material white roughness=2
expect_error "no open scene 'elsewhere'" edit --scene elsewhere list
expect_ok "view" env SDL_VIDEODRIVER=dummy timeout 60 "$bin/tessera" view --server "$address" --size 400x300 --frames 2 --screenshot "$work/view.png"
[[ -s $work/view.png ]] || fail "view makes no screenshot"
expect_ok "bench view" tessera bench view cornell --size 64x48 --changes 2 --threads 1 --json "$work/latency.json"
grep -q '"latency_first_s"' "$work/latency.json" || fail "bench view does not tell the latency"
kill $server

# A server for the network: keys for each role, and for nobody else.
unset TESSERA_TOKEN
expect_error "tessera keys" timeout 20 "$bin/tessera-server" --listen 0.0.0.0:0
expect_ok "keys" tessera keys "$work/keys"
expect_error "exists already" tessera keys "$work/keys"
"$bin/tessera-server" cornell --listen 0.0.0.0:0 --keys "$work/keys/server" >"$work/greeting" 2>"$work/server.log" &
server=$!
read -r _ _ address <"$work/greeting"
address=127.0.0.1:${address##*:}
"$bin/tessera-worker" --server "$address" --threads 1 --keys "$work/keys/worker" 2>"$work/worker.log" &
render_there=(tessera render cornell -o "$work/tls.png" --size 64x48 --server "$address")
expect_ok "render by TLS" "${render_there[@]}" --keys "$work/keys/editor"
expect_ok "status by TLS" env TESSERA_KEYS="$work/keys/viewer" "$bin/tessera" status --server "$address"
expect_error "not to edit" "${render_there[@]}" --keys "$work/keys/viewer"
expect_error "give --keys" "${render_there[@]}"
# The client that knows the protocol from its .proto files alone.
minimal=$(dirname "$0")/../client/minimal.py
if /usr/bin/python3 -c 'import google.protobuf' 2>/dev/null; then
    expect_ok "minimal client" /usr/bin/python3 "$minimal" "$address" cornell "$work/m.ppm" --size 64x48 --keys "$work/keys/viewer"
    [[ $(stat -c %s "$work/m.ppm") -eq $((13 + 64 * 48 * 3)) ]] || fail "no picture from the minimal client"
else
    echo "skipped: the minimal client in Python, for want of python3-protobuf"
fi
kill $server

# However the client ends, its cluster ends.
for signal in INT KILL; do
    "$bin/tessera" render office -o "$work/x.png" --size 1600x1200 --passes 5000 2>/dev/null &
    client=$!
    children=$(children_of $client)
    kill -$signal $client
    wait $client 2>/dev/null
    status=$?
    [[ $signal == KILL || $status -eq 130 ]] || fail "exit status $status after Ctrl-C"
    for child in $children; do
        timeout 5 tail --pid="$child" -f /dev/null || fail "process $child outlives a client ended by $signal"
    done
done

# Even one that had only begun to start.
timeout 20 "$bin/tessera-worker" --server 127.0.0.1:1 --exit-with-parent 1 2>/dev/null
[[ $? -eq 1 ]] || fail "a worker goes on without the parent that started it"

[[ $failures -eq 0 ]] && echo "all good"
exit "$failures"
