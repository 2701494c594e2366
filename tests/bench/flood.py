#!/usr/bin/env python3
"""Strangers at a server's door: connections that say nothing, that say nonsense, and that speak a byte at a time.

    tests/bench/flood.py HOST:PORT [--rate 1000] [--seconds 10] [--pid PID_OF_THE_SERVER]

Run it while a viewer renders, and compare the viewer's time with and without: what strangers cost those who are in. Prints
how many connections were made, how many the server closed within the time, and (with --pid) what CPU time it took meanwhile.
"""
import argparse
import asyncio
import os
import random
import time

HELLO = b"TSR1\x01\x00\x00\x00\x40\x00\x00\x00\x00\x00\x00\x00"  # the header of a Hello that never comes


async def silent(reader, writer):
    await reader.read()


async def nonsense(reader, writer):
    writer.write(os.urandom(random.randrange(1, 200)))
    await reader.read()


async def slow(reader, writer):
    for byte in HELLO + bytes(64):
        writer.write(bytes([byte]))
        await writer.drain()
        await asyncio.sleep(0.2)


async def stranger(host, port, counts):
    try:
        reader, writer = await asyncio.open_connection(host, port)
    except OSError:
        counts["refused"] += 1
        return
    counts["connected"] += 1
    try:
        behave = random.choice((silent, silent, nonsense, slow))
        await asyncio.wait_for(behave(reader, writer), 30)
    except (OSError, asyncio.TimeoutError):
        pass
    counts["closed by the server"] += reader.at_eof()
    writer.close()


def cpu_seconds(pid):
    with open(f"/proc/{pid}/stat") as stat:
        user, system = stat.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


async def flood(host, port, rate, seconds):
    counts = {"connected": 0, "refused": 0, "closed by the server": 0}
    begin = time.monotonic()
    peers = set()
    made = 0
    while (now := time.monotonic() - begin) < seconds:
        for _ in range(int(now * rate) - made):
            peers.add(task := asyncio.ensure_future(stranger(host, port, counts)))
            task.add_done_callback(peers.discard)
            made += 1
        await asyncio.sleep(0.005)
    counts["still open"] = len(peers)
    print(", ".join(f"{count} {what}" for what, count in counts.items()), f"in {seconds} s")
    for task in peers:
        task.cancel()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("server", metavar="HOST:PORT")
    parser.add_argument("--rate", type=float, default=1000, help="connections a second")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--pid", type=int)
    options = parser.parse_args()
    host, port = options.server.rsplit(":", 1)
    before = cpu_seconds(options.pid) if options.pid else 0
    asyncio.run(flood(host, int(port), options.rate, options.seconds))
    if options.pid:
        print(f"{cpu_seconds(options.pid) - before:.2f} s of the server's CPU time")


if __name__ == "__main__":
    main()
