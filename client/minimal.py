#!/usr/bin/env python3
"""A whole viewer in a hundred lines: asks a server for a picture of a scene that it has loaded.

    client/minimal.py HOST:PORT SCENE OUT.ppm [--eye x,y,z --at x,y,z] [--size WxH] [--keys FOLDER]

It knows the protocol only from proto/*.proto, which protoc (Debian: protobuf-compiler) translates when it starts, with
Debian's python3-protobuf. Start from here to write a client in another language.
"""
import argparse
import importlib
import os
import pathlib
import socket
import ssl
import struct
import subprocess
import sys
import tempfile

PROTOCOL = 5
HEADER = struct.Struct("<4sHHII")  # magic, kind, reserved, message bytes, payload bytes
PROTO = pathlib.Path(__file__).resolve().parent.parent / "proto"


def load_messages():
    """The module that protoc makes of protocol.proto."""
    with tempfile.TemporaryDirectory() as out:
        subprocess.run(["protoc", f"--python_out={out}", f"-I{PROTO}", "scene.proto", "protocol.proto"], check=True)
        sys.path.insert(0, out)
        return importlib.import_module("protocol_pb2")


class Connection:
    """Frames over a socket: a header, a message, and with some kinds a payload."""

    def __init__(self, wire, address, keys):
        self.wire = wire
        host, port = address.rsplit(":", 1)
        self.socket = socket.create_connection((host, int(port)))
        if keys:
            context = ssl.create_default_context(cafile=keys / "authority.crt")
            context.minimum_version = ssl.TLSVersion.TLSv1_3
            context.check_hostname = False  # certificates name the role, not the host
            self.socket = context.wrap_socket(self.socket)

    def send(self, message):
        kind = self.wire.Kind.Value("KIND_" + "".join("_" * c.isupper() + c.upper() for c in type(message).__name__)[1:])
        body = message.SerializeToString()
        self.socket.sendall(HEADER.pack(b"TSR1", kind, 0, len(body), 0) + body)

    def receive(self):
        """The next message and its payload; pings are answered on the way."""
        magic, kind, _, message_bytes, payload_bytes = HEADER.unpack(self.read(HEADER.size))
        if magic != b"TSR1":
            sys.exit("this is no tessera-server")
        name = self.wire.Kind.Name(kind)[len("KIND_") :].title().replace("_", "")
        message = getattr(self.wire, name).FromString(self.read(message_bytes))
        payload = self.read(payload_bytes)
        if name in ("Refused", "Failure"):
            sys.exit(f"the server: {message.reason.decode()}")
        if name == "Ping":
            self.send(self.wire.Pong(stamp=message.stamp))
            return self.receive()
        return message, payload

    def read(self, size):
        data = bytearray()
        while len(data) < size:
            piece = self.socket.recv(size - len(data))
            if not piece:
                sys.exit("the server has closed the connection")
            data += piece
        return bytes(data)


def render(wire, connection, options):
    """The picture: 8-bit sRGB, rows from the top."""
    token = (options.keys / "token").read_bytes().strip() if options.keys else os.environb.get(b"TESSERA_TOKEN", b"")
    connection.send(wire.Hello(protocol=PROTOCOL, role=wire.ROLE_VIEWER, build=b"minimal.py", token=token, name=b"minimal"))
    welcome, _ = connection.receive()
    if options.scene.encode() not in welcome.scenes:
        sys.exit(f"the server has no scene '{options.scene}', only: {b', '.join(welcome.scenes).decode()}")

    request = wire.FrameRequest(request=1, format=wire.PICTURE_FORMAT_SRGB8, tone_curve=wire.TONE_CURVE_SRGB)
    spec = request.spec
    spec.scene, (spec.width, spec.height) = options.scene.encode(), options.size
    for name, point in (("eye", options.eye), ("at", options.at), ("up", (0, 1, 0))):
        place = getattr(spec.camera, name)
        place.x, place.y, place.z = point
    spec.camera.fov_y = 60
    settings = spec.settings
    settings.integrator, settings.tracer = wire.INTEGRATOR_IGI, wire.TRACER_KDTREE
    settings.filter = wire.FILTER_PLACE_SERVER
    settings.passes, settings.vpls, settings.interleave, settings.bounces = 4, 2, 9, 64
    connection.send(request)

    picture = bytearray(3 * spec.width * spec.height)
    while True:
        message, payload = connection.receive()
        if isinstance(message, wire.PictureChunk):
            picture[message.offset : message.offset + len(payload)] = payload
        elif isinstance(message, wire.FrameDone):
            print(f"{message.statistics.render_seconds:.2f} s, estimated error {message.statistics.error_estimate:.4f}")
            return picture


def numbers(separator, kind):
    return lambda text: tuple(kind(part) for part in text.split(separator))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("server", metavar="HOST:PORT")
    parser.add_argument("scene")
    parser.add_argument("output", type=pathlib.Path)
    parser.add_argument("--eye", type=numbers(",", float), default=(0.278, 0.273, -0.8))
    parser.add_argument("--at", type=numbers(",", float), default=(0.278, 0.273, 0.0))
    parser.add_argument("--size", type=numbers("x", int), default=(256, 256))
    parser.add_argument("--keys", type=pathlib.Path, help="folder that `tessera keys` made")
    options = parser.parse_args()
    wire = load_messages()
    picture = render(wire, Connection(wire, options.server, options.keys), options)
    options.output.write_bytes(b"P6 %d %d 255\n" % options.size + picture)


if __name__ == "__main__":
    main()
