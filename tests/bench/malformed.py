#!/usr/bin/env python3
"""Peers that break the protocol in every way that this script knows, one frame each, against a running server without keys.

    tests/bench/malformed.py HOST:PORT [--frames 100000] [--pid PID_OF_THE_SERVER]

Half of them are let in first, as viewers or as workers. Ends with status 1 when the server stops answering, leaves a peer that
broke the protocol connected, or (with --pid) has grown by more than 64 MB since the first tenth of the frames. Run it while a
viewer renders to see that others notice nothing.
"""
import argparse
import asyncio
import collections
import os
import random
import struct
import sys
import time

WORKER, VIEWER = 1, 2
KINDS = 32  # of messages, from 1
MOST_MESSAGE, MOST_PAYLOAD = 256 << 20, 4 << 20
PATIENCE = 20  # seconds until the server must have hung up


def frame(kind, message=b"", payload=b"", magic=b"TSR1", reserved=0, message_bytes=None, payload_bytes=None):
    return magic + struct.pack("<HHII", kind, reserved, len(message) if message_bytes is None else message_bytes,
                               len(payload) if payload_bytes is None else payload_bytes) + message + payload


def hello(role):
    token = os.environ.get("TESSERA_TOKEN", "").encode()
    return frame(1, bytes([8, 4, 16, role, 34, len(token)]) + token)


def noise(most=200):
    return random.randbytes(random.randrange(1, most))


def any_kind():
    return random.randrange(1, KINDS + 1)


# Each is sent by a peer that then says no more.
MALFORMED = {
    "no frame": lambda: b"x" * 16 + noise(),
    "reserved bits": lambda: frame(any_kind(), reserved=random.randrange(1, 1 << 16)),
    "message too long": lambda: frame(any_kind(), message_bytes=MOST_MESSAGE + random.randrange(1, 1 << 30)),
    "payload too long": lambda: frame(any_kind(), payload_bytes=MOST_PAYLOAD + random.randrange(1, 1 << 30)),
    "unknown kind": lambda: frame(random.randrange(KINDS + 1, 1 << 16), noise()),
    "message of noise": lambda: frame(any_kind(), b"\x0f" + noise()),  # no field has wire type 7
    "payload where none goes": lambda: frame(21, b"", noise()),
    "ends early": lambda: frame(any_kind(), noise(), message_bytes=1000),
    "a server's message": lambda: frame(random.choice((2, 3, 11, 26)), b""),
    "hello again": lambda: hello(random.choice((WORKER, VIEWER))),
}


async def break_protocol(host, port, counts):
    what = random.choice(list(MALFORMED))
    reader, writer = await asyncio.open_connection(host, port)
    let_in = what == "hello again" or random.random() < 0.5
    if let_in:
        writer.write(hello(random.choice((WORKER, VIEWER))))
    writer.write(MALFORMED[what]())
    if what == "ends early":
        writer.write_eof()
    try:
        heard = await asyncio.wait_for(reader.read(), PATIENCE)
    except asyncio.TimeoutError:
        counts["left connected after: " + what] += 1
        return
    counts["told why"] += let_in and b"TSR1\x03\x00" in heard
    counts[what] += 1
    writer.close()


async def peers(host, port, frames, counts):
    while sum(counts[what] for what in MALFORMED) < frames:
        try:
            await break_protocol(host, port, counts)
        except OSError:  # the server hung up before all was said
            counts["reset"] += 1


def resident_mb(pid):
    with open(f"/proc/{pid}/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGESIZE") >> 20


async def run(options):
    host, port = options.server.rsplit(":", 1)
    counts = collections.Counter()
    begin = time.monotonic()

    async def load(frames):
        await asyncio.gather(*(peers(host, int(port), frames, counts) for _ in range(options.peers)))

    await load(options.frames // 10)
    before = resident_mb(options.pid) if options.pid else 0
    await load(options.frames)
    after = resident_mb(options.pid) if options.pid else 0
    for what, count in sorted(counts.items()):
        print(f"{count:9} {what}")
    print(f"in {time.monotonic() - begin:.0f} s; resident memory {before} MB after a tenth, {after} MB at the end")
    return not any("left connected" in what for what in counts) and after - before <= 64


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("server", metavar="HOST:PORT")
    parser.add_argument("--frames", type=int, default=100000)
    parser.add_argument("--peers", type=int, default=32, help="at a time")
    parser.add_argument("--pid", type=int, help="of the server, to watch its memory")
    sys.exit(0 if asyncio.run(run(parser.parse_args())) else 1)


if __name__ == "__main__":
    main()
