#!/usr/bin/env bash
# Starts a worker on each host by ssh and ends them all on Ctrl-C. The hosts need tessera-worker in their PATH
# and you a login without a password; keys go there by scp and are removed again.
# usage: deploy/ssh-workers.sh SERVER:PORT KEYS_FOLDER HOST...
set -uo pipefail
if [[ $# -lt 3 ]]; then sed -n '2,4s/^# //p' "$0" >&2; exit 2; fi
server=$1 keys=$2; shift 2
[[ -f $keys/token && -f $keys/private.key ]] || { echo "$keys: no worker's keys; give the folder keys/worker that \`tessera keys\` made" >&2; exit 1; }

one_worker() {
    local host=$1 folder
    folder=$(ssh -o BatchMode=yes "$host" 'umask 077 && mktemp -d') || { echo "$host: cannot log in" >&2; return 1; }
    scp -q -o BatchMode=yes "$keys"/* "$host:$folder/" || { echo "$host: cannot copy the keys" >&2; return 1; }
    # The worker there ends when its side of our open stdin does, however that happens.
    ssh -o BatchMode=yes "$host" "exec 3<&0
        tessera-worker --server '$server' --keys '$folder' </dev/null & worker=\$!
        { cat; kill \$worker; } <&3 >/dev/null 2>&1 &
        wait \$worker; rm -rf '$folder'" \
        < <(exec tail -f /dev/null) > >(sed -u "s/^/$host: /") 2>&1 &
    trap "kill $! 2>/dev/null" TERM
    wait $!
}

trap 'kill $(jobs -p) 2>/dev/null' EXIT
for host in "$@"; do one_worker "$host" & done
wait
