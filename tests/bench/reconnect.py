#!/usr/bin/env python3
"""Peers that come and go: does the server grow, does it get slower?

    tests/bench/reconnect.py BIN_FOLDER [--viewers 1000] [--workers 100]

Starts a server and a worker, lets viewers connect, see one small picture and go, one after another, then kills the worker
and starts another, again and again. Prints the server's memory, its descriptors and the time to a picture as it goes on.
"""
import argparse
import contextlib
import importlib.util
import io
import pathlib
import signal
import statistics
import subprocess
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("minimal", ROOT / "client" / "minimal.py")
minimal = importlib.util.module_from_spec(spec)
spec.loader.exec_module(minimal)

ROWS = 10


class Cluster:
    def __init__(self, programs):
        self.programs = programs
        self.server = subprocess.Popen(
            [programs / "tessera-server", "cornell", "--listen", "127.0.0.1:0", "--log", "error"],
            stdout=subprocess.PIPE, text=True)
        self.address = self.server.stdout.readline().split()[-1]
        self.start_worker()
        self.wire = minimal.load_messages()

    def start_worker(self):
        self.worker = subprocess.Popen(
            [self.programs / "tessera-worker", "--server", self.address, "--threads", "1", "--log", "off"])

    def restart_worker(self):
        self.worker.send_signal(signal.SIGKILL)
        self.worker.wait()
        self.start_worker()

    def visit(self):
        """Seconds from connecting to the whole picture."""
        options = argparse.Namespace(keys=None, scene="cornell", size=(64, 48), eye=(0.278, 0.273, -0.8),
                                     at=(0.278, 0.273, 0.0))
        begin = time.monotonic()
        connection = minimal.Connection(self.wire, self.address, None)
        with contextlib.redirect_stdout(io.StringIO()):
            minimal.render(self.wire, connection, options)
        connection.socket.close()
        return time.monotonic() - begin

    def state(self):
        process = pathlib.Path("/proc") / str(self.server.pid)
        resident = int((process / "statm").read_text().split()[1]) * 4096
        return resident / 1e6, len(list((process / "fd").iterdir()))

    def stop(self):
        for process in (self.worker, self.server):
            process.terminate()
            process.wait()


def repeat(cluster, what, count, before_each):
    times = []
    print(f"{what:>16} {'memory MB':>10} {'descriptors':>12} {'time to a picture, median ms':>30}")
    for i in range(1, count + 1):
        before_each()
        times.append(cluster.visit())
        if i % max(count // ROWS, 1) == 0:
            memory, descriptors = cluster.state()
            print(f"{i:>16} {memory:>10.1f} {descriptors:>12} {1e3 * statistics.median(times):>30.1f}", flush=True)
            times.clear()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("programs", metavar="BIN_FOLDER", type=pathlib.Path)
    parser.add_argument("--viewers", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=100)
    options = parser.parse_args()
    cluster = Cluster(options.programs.resolve())
    try:
        repeat(cluster, "viewers", options.viewers, lambda: None)
        repeat(cluster, "workers", options.workers, cluster.restart_worker)
    finally:
        cluster.stop()


if __name__ == "__main__":
    main()
