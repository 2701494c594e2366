#!/usr/bin/env python3
"""Browsers at a gateway: the page and its view over HTTP and WebSocket, and what is not taken from whom. Where
Chromium is installed, the page itself is driven in it, too: a picture, a pick, an edit, by mouse and by touch.

    web_test.py BIN_FOLDER [--screenshots FOLDER]

The processes are real, on loopback; the WebSockets are the few lines below.
"""
import base64
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request

PATIENCE = 60  # seconds until something counts as hanging
BROWSERS = 8   # places at the gateway


class WebSocket:
    """RFC 6455, a client's side: whole messages, masked."""

    def __init__(self, url, origin=None, host=None):
        address, path = re.fullmatch(r"\w+://([^/]+)(/.*)", url).groups()
        name, port = address.rsplit(":", 1)
        self.socket = socket.create_connection((name, int(port)), timeout=PATIENCE)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        lines = [f"GET {path} HTTP/1.1", f"Host: {host or address}", "Upgrade: websocket", "Connection: Upgrade",
                 f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}", "Sec-WebSocket-Version: 13"]
        if origin:
            lines.append(f"Origin: {origin}")
        self.socket.sendall("\r\n".join(lines + ["", ""]).encode())
        self.input = self.socket.makefile("rb")
        self.status = int(self.input.readline().split()[1])
        while self.input.readline() not in (b"\r\n", b""):
            pass

    def send(self, message, opcode=1):
        data = message if isinstance(message, bytes) else json.dumps(message).encode()
        mask = os.urandom(4)
        length = bytes([128 | len(data)]) if len(data) < 126 else (
            struct.pack("!BH", 254, len(data)) if len(data) < 65536 else struct.pack("!BQ", 255, len(data)))
        self.socket.sendall(bytes([128 | opcode]) + length + mask + bytes(b ^ mask[i % 4] for i, b in enumerate(data)))

    def receive(self):
        """The next message; a string, bytes, or None and the reason in `self.reason` when there will be no more."""
        whole = b""
        while True:
            head = self.input.read(2)
            if len(head) < 2:
                self.reason = "gone"
                return None
            length = head[1] & 127
            if length > 125:
                length = int.from_bytes(self.input.read(2 if length == 126 else 8), "big")
            data, opcode = self.input.read(length), head[0] & 15
            if opcode == 8:
                self.reason = data[2:].decode()
                return None
            if opcode == 9:
                self.send(data, 10)
            if opcode < 3:
                kind, whole = (opcode or kind), whole + data
                if head[0] & 128:
                    return whole.decode() if kind == 1 else whole


class Cluster:
    """A server with a scene, a worker and a gateway."""

    def __init__(self, programs, scene, *options):
        self.processes = []
        self.environment = {**os.environ, "TESSERA_TOKEN": "secret"}
        server = self.start(f"{programs}/tessera-server", scene, "--listen", "127.0.0.1:0", "--log", "warning")
        self.server = server.stdout.readline().split()[-1]
        self.start(f"{programs}/tessera-worker", "--server", self.server, "--log", "warning")
        gateway = self.start(f"{programs}/tessera-web", "--server", self.server, "--listen", "127.0.0.1:0",
                             "--log", "warning", *options)
        self.url = gateway.stdout.readline().split()[-1]

    def start(self, *command):
        self.processes.append(subprocess.Popen(command, env=self.environment, stdout=subprocess.PIPE, text=True))
        return self.processes[-1]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.terminate()
            assert process.wait(PATIENCE) == 0, f"{process.args} ends with {process.returncode}"

    def open(self, **options):
        return WebSocket(self.url, **{"origin": self.url.rstrip("/"), **options})


def view(about, **changes):
    camera = {key: about["home"][key] for key in ("eye", "at", "up", "fov")}
    return {"view": {"camera": camera, "size": [160, 120], "exposure": 0, "filmic": True, "reference": False,
                     "channel": "picture", "stamp": 1, **changes}}


def hear(page, key):
    """The next message of that kind."""
    while True:
        message = page.receive()
        assert message is not None, f"closed: {page.reason}"
        if isinstance(message, str) and key in json.loads(message):
            return json.loads(message)[key]


def picture(page, good=lambda header: True):
    """The next picture whose header is as wanted, and its bytes."""
    while True:
        message = page.receive()
        assert message is not None, f"closed: {page.reason}"
        if isinstance(message, bytes):
            length = struct.unpack("<I", message[:4])[0]
            header = json.loads(message[4:4 + length])
            page.send({"shown": True, "seconds": 0.01})
            if good(header):
                return header, message[4 + length:]


def test_page(cluster):
    for path, type_, part in [("", "text/html", "<canvas"), ("viewer.js", "text/javascript", "WebSocket"),
                              ("viewer.css", "text/css", "canvas")]:
        with urllib.request.urlopen(cluster.url + path, timeout=PATIENCE) as answer:
            assert type_ in answer.headers["Content-Type"] and part in answer.read().decode(), path
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    for path, headers, status in [("missing", {}, 404), ("", {"Host": "evil.example"}, 421)]:
        try:
            urllib.request.urlopen(urllib.request.Request(cluster.url + path, headers=headers), timeout=PATIENCE)
            raise AssertionError(f"{path} {headers} is answered")
        except urllib.error.HTTPError as error:
            assert error.code == status, error


def test_view(cluster):
    page = cluster.open()
    about = hear(page, "about")
    page.send(view(about))
    header, data = picture(page)
    assert header["type"] == "image/jpeg" and data[:2] == b"\xff\xd8", header
    assert (header["width"], header["height"], header["stamp"]) == (160, 120, 1), header
    # The newest camera wins, and a picture that stays becomes exact.
    for stamp in range(2, 20):
        page.send(view(about, stamp=stamp, size=[80, 60], exposure=stamp / 10))
    header, data = picture(page, lambda h: h["stamp"] == 19 and h["settled"])
    assert header["type"] == "image/png" and data[:4] == b"\x89PNG", header
    assert (header["width"], header["height"]) == (80, 60), header
    return page, about


def test_pick_and_edit(cluster):
    page, about = test_view(cluster)
    page.send({"pick": [0, -0.9], "number": 7})
    picked = hear(page, "picked")
    assert picked["number"] == 7 and len(picked["point"]) == 3, picked
    page.send({"select": picked["instance"]})
    selection = hear(page, "about")["selection"]
    assert selection["instance"] == picked["instance"], selection
    # Another browser's view follows an edit.
    other, _ = test_view(cluster)
    page.send({"edit": {"set": "material", "name": picked["material"], "to": {"base_color": [0, 0.5, 0]}}})
    page.send({"edit": {"move": picked["instance"], "to": [0, 0.01, 0]}})
    for browser in (page, other):
        header, _ = picture(browser, lambda h: h["version"] > about["version"])
    page.send({"select": picked["instance"]})
    while True:
        selection = hear(page, "about")["selection"]
        if selection["place"][1] > 0 and selection["materials"][0]["base_color"] == [0, 0.5, 0]:
            break
    page.send({"edit": {"move": "nobody", "to": [0, 0, 0]}})
    assert "nobody" in hear(page, "notice")


def test_slow_page(cluster):
    """Who does not show pictures gets no more than two, and hears all else."""
    page = cluster.open()
    about = hear(page, "about")
    pictures = 0
    for stamp in range(1, 6):
        page.send(view(about, stamp=stamp, exposure=stamp))
        page.send({"pick": [0, 0], "number": stamp})
        while True:
            message = page.receive()
            pictures += isinstance(message, bytes)
            if isinstance(message, str) and json.loads(message).get("picked", {}).get("number") == stamp:
                break
    # Status comes every second.
    for _ in range(2):
        while isinstance(message := page.receive(), bytes) or "status" not in message:
            pictures += isinstance(message, bytes)
    assert pictures == 2, pictures


def test_motion(programs):
    """What moves plays, stops, and goes where the slider says; every page sees it."""
    with Cluster(programs, "museum:64", "--motion", "museum:64", "--passes", "2") as cluster:
        page, other = cluster.open(), cluster.open()
        about = hear(page, "about")
        page.send(view(about, size=[48, 32]))
        other.send(view(about, size=[48, 32]))
        page.send({"seek": 2.5})
        while (motion := hear(page, "motion"))["seconds"] != 2.5:
            pass
        assert not motion["playing"] and motion["duration"] == 8, motion
        for browser in (page, other):
            picture(browser, lambda h: h["version"] > about["version"])
        page.send({"play": True})
        while not (motion := hear(page, "motion"))["playing"] or motion["seconds"] <= 2.5:
            pass
        page.send({"play": False})
        while hear(page, "motion")["playing"]:
            pass


def test_channels(cluster):
    page = cluster.open()
    about = hear(page, "about")
    for stamp, channel in enumerate(["path length", "error", "tile owner"], 1):
        page.send(view(about, stamp=stamp, channel=channel))
        picture(page, lambda h: h["stamp"] == stamp and h["settled"])


def test_strangers(cluster):
    assert cluster.open().status == 101
    assert cluster.open(origin="http://evil.example").status == 403
    assert cluster.open(origin=None).status == 403
    assert cluster.open(origin="http://evil.example", host="evil.example").status == 403


def test_nonsense(cluster):
    """Ends the view that it comes from, and no other."""
    good, about = test_view(cluster)
    eye = about["home"]["eye"]
    home = {key: about["home"][key] for key in ("eye", "at", "up", "fov")}
    for nonsense in [b"{", b"[]", b'"view"', b"\xff\xfe", {}, {"view": 1}, {"pick": [1]}, {"dance": True},
                     b"[" * 4000, b" " * 5000, b"\0" * 100, {"select": 5}, {"pick": ["a", 0], "number": 0},
                     view(about, size=[0, 10]), view(about, size=[8000, 8000]), view(about, size=[1e300, 1]),
                     view(about, channel="x"), view(about, exposure=1e9), view(about, exposure="1"),
                     view(about, camera={**home, "at": eye}), view(about, camera={**home, "eye": [1e300, 0, 0]}),
                     view(about, stamp="x"), view(about, stamp=-1), view(about, stamp=1e300)]:
        page = cluster.open()
        hear(page, "about")
        page.send(nonsense)
        while page.receive() is not None:
            pass
    good.send(view(about, stamp=77))
    picture(good, lambda h: h["stamp"] == 77)


def test_full(cluster):
    pages = []
    while (page := cluster.open()).receive() is not None:
        pages.append(page)
    assert len(pages) <= BROWSERS and "places" in page.reason, page.reason
    pages[0].socket.shutdown(socket.SHUT_RDWR)
    while cluster.open().receive() is None:
        pass


def test_options(programs):
    def complaint(*options):
        run = subprocess.run([f"{programs}/tessera-web", "--server", "127.0.0.1:1", *options], capture_output=True,
                             text=True, timeout=PATIENCE, check=False)
        assert run.returncode != 0
        return run.stderr
    assert "--public" in complaint("--listen", "0.0.0.0:0")
    assert "--listen" in complaint("--listen", "nonsense:0")


# ---- The page in a browser ------------------------------------------------------------------------


class Chromium:
    """Driven by its DevTools protocol."""

    def __init__(self, program, url):
        self.folder = tempfile.mkdtemp()
        self.process = subprocess.Popen(
            [program, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
             "--remote-debugging-port=0", f"--user-data-dir={self.folder}", url],
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        for line in self.process.stderr:
            if "DevTools listening on" in line:
                break
        port = re.search(r":(\d+)/", line).group(1)
        tab = None
        while not tab:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE) as answer:
                tab = next((t for t in json.load(answer) if t["url"] == url), None)
        self.socket = WebSocket(tab["webSocketDebuggerUrl"])
        self.number = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(PATIENCE)
        shutil.rmtree(self.folder, ignore_errors=True)

    def call(self, method, **parameters):
        self.number += 1
        self.socket.send({"id": self.number, "method": method, "params": parameters})
        while True:
            answer = json.loads(self.socket.receive())
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, script):
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, condition):
        """Until the condition holds, looked at with every frame."""
        self.value(f"""new Promise((yes, no) => {{
            const end = performance.now() + {1000 * PATIENCE};
            const look = () => ({condition}) ? yes() : performance.now() > end ? no({json.dumps(condition)})
                                             : requestAnimationFrame(look);
            look(); }})""")

    def screen(self, width, height, phone):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, mobile=phone,
                  deviceScaleFactor=2 if phone else 1)
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        self.call("Page.reload")
        self.wait("/pass \\d|settled/.test(document.querySelector('#statistics')?.textContent)")

    def mouse(self, *steps):
        for kind, x, y, button in steps:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1,
                      buttons={"none": 0, "left": 1, "right": 2}[button])

    def drag(self, start, end, button="left"):
        half = [(a + b) / 2 for a, b in zip(start, end)]
        self.mouse(("mousePressed", *start, button), ("mouseMoved", *half, button), ("mouseMoved", *end, button),
                   ("mouseReleased", *end, button))

    def touch(self, *steps):
        for kind, *points in steps:
            self.call("Input.dispatchTouchEvent", type=kind,
                      touchPoints=[{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)])

    def screenshot(self, folder, name):
        if folder:
            self.value("new Promise(shown => requestAnimationFrame(() => requestAnimationFrame(() => shown())))")
            with open(os.path.join(folder, f"{name}.png"), "wb") as file:
                file.write(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


PICTURE = "document.querySelector('#picture').toDataURL()"
SELECTED = "document.querySelector('#chip').textContent"
VERSION = "document.querySelector('#version').textContent"


def expect_change(browser, what, gesture):
    before = browser.value(what)
    gesture()
    browser.wait(f"{what} !== {json.dumps(before)}")


def test_browser(program, cluster, screenshots):
    with Chromium(program, cluster.url) as browser:
        browser.screen(1280, 800, phone=False)
        # By mouse: turn, pan, come nearer, select, move, edit.
        expect_change(browser, PICTURE, lambda: browser.drag((400, 400), (460, 380)))
        expect_change(browser, PICTURE, lambda: browser.drag((400, 400), (430, 420), "right"))
        expect_change(browser, PICTURE, lambda: browser.call(
            "Input.dispatchMouseEvent", type="mouseWheel", x=400, y=400, deltaX=0, deltaY=-100))
        expect_change(browser, SELECTED, lambda: browser.drag((470, 560), (470, 560)))
        expect_change(browser, VERSION, lambda: browser.drag((470, 560), (500, 570)))
        roughness = "[...document.querySelectorAll('#selection input[type=range]')][0]"
        expect_change(browser, VERSION, lambda: browser.value(
            f"{roughness}.value = 0.35, {roughness}.dispatchEvent(new Event('input')), 0"))
        browser.screenshot(screenshots, "desktop")
        # Channels with their legends.
        choice = "document.querySelector('#display select')"
        for channel in ("path length", "tile owner", "error"):
            expect_change(browser, PICTURE, lambda: browser.value(
                f"{choice}.value = '{channel}', {choice}.dispatchEvent(new Event('change')), 0"))
            browser.wait(f"document.querySelector('#legend strong').textContent === '{channel}'")
        browser.screenshot(screenshots, "error")
        browser.value(f"{choice}.value = 'picture', {choice}.dispatchEvent(new Event('change')), 0")
        # By touch: turn, pinch, select.
        browser.screen(390, 844, phone=True)
        expect_change(browser, PICTURE, lambda: browser.touch(
            ("touchStart", (200, 300)), ("touchMove", (170, 310)), ("touchMove", (150, 320)), ("touchEnd",)))
        expect_change(browser, PICTURE, lambda: browser.touch(
            ("touchStart", (200, 300)), ("touchStart", (200, 300), (220, 400)), ("touchMove", (200, 280), (220, 430)),
            ("touchEnd",)))
        expect_change(browser, SELECTED, lambda: browser.touch(("touchStart", (200, 500)), ("touchEnd",)))
        browser.screenshot(screenshots, "phone")
        expect_change(browser, "document.body.className", lambda: browser.value("document.querySelector('#toggle').click()"))
        browser.screenshot(screenshots, "phone-panel")


def test_browser_motion(program, cluster, screenshots):
    """What moves plays, stops, and goes where the slider is put."""
    with Chromium(program, cluster.url) as browser:
        browser.screen(1280, 800, phone=False)
        browser.wait("!document.querySelector('#motion').hidden")
        expect_change(browser, VERSION, lambda: browser.value("document.querySelector('#play').click()"))
        browser.wait("document.querySelector('#play').textContent === 'pause'")
        browser.value("document.querySelector('#play').click()")
        browser.wait("document.querySelector('#play').textContent === 'play'")
        slider = "document.querySelector('#seconds')"
        expect_change(browser, VERSION, lambda: browser.value(
            f"{slider}.value = 1, {slider}.dispatchEvent(new Event('input')), 0"))
        browser.wait(f"{slider}.nextElementSibling.textContent === '1.0 s'")
        browser.screenshot(screenshots, "motion")


def main():
    programs = sys.argv[1]
    screenshots = sys.argv[3] if len(sys.argv) > 3 else None
    test_options(programs)
    test_motion(programs)
    with Cluster(programs, "cornell", "--passes", "4", "--browsers", str(BROWSERS)) as cluster:
        for test in (test_page, test_view, test_pick_and_edit, test_slow_page, test_channels, test_strangers, test_nonsense, test_full):
            began = time.monotonic()
            test(cluster)
            print(f"{test.__name__}: passes ({time.monotonic() - began:.1f} s)", flush=True)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if not chromium:
        print("skipped: the page in a browser, for want of chromium")
        return
    with Cluster(programs, os.environ.get("TESSERA_WEB_SCENE", "cornell")) as cluster:
        test_browser(chromium, cluster, screenshots)
    moving = os.environ.get("TESSERA_WEB_MOTION", "museum:64")
    with Cluster(programs, moving, "--motion", moving) as cluster:
        test_browser_motion(chromium, cluster, screenshots)
    print("all good")


main()
