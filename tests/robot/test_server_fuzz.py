"""Broken messages cost their connection: the server goes on, and neither memory nor files grow."""

import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pipeline.robot import wire
from pipeline.robot.client import PolicyClient

ROOT = Path(__file__).resolve().parents[2]
GROWTH_MB = 24
"""Beyond what a server holds after its first messages."""

SERVER = """
import gc, runpy, signal, sys
import torch
from pipeline.base.config import ServeParams
from pipeline.robot.server import PolicyServer, listen
from pipeline.robot.session import ServedPolicy

torch.set_num_threads(1)
signal.signal(signal.SIGUSR1, lambda *_: print(gc.collect(), flush=True))
checkpoint, policy, glance = runpy.run_path(sys.argv[1])["build_policy"]()
glance.passes = type("Forgetful", (list,), {"append": lambda *_: None})()
glance.instructions = glance.passes
params = ServeParams(port=0, max_message_mb=1, max_connections=64)
served = ServedPolicy(checkpoint, policy, glance, "head")
server = PolicyServer(served, params, None, listen(params))
server.run(lambda: print(server.address, flush=True))
"""


@dataclass
class Running:
    """A server in a process of its own."""

    process: subprocess.Popen[str]
    address: str

    def held(self) -> tuple[float, int]:
        """Its memory in MB once garbage is collected, and its open files."""
        self.process.send_signal(signal.SIGUSR1)
        assert self.process.stdout is not None and self.process.stdout.readline()
        place = Path("/proc") / str(self.process.pid)
        (kilobytes,) = re.findall(r"VmRSS:\s+(\d+) kB", (place / "status").read_text())
        return int(kilobytes) / 1000, len(os.listdir(place / "fd"))


@pytest.fixture
def running() -> Iterator[Running]:
    script = [sys.executable, "-c", SERVER, str(Path(__file__).with_name("conftest.py"))]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    process = subprocess.Popen(script, stdout=pipe, stderr=pipe, text=True, env=environment)
    assert process.stdout is not None and process.stderr is not None
    address = process.stdout.readline().strip()
    assert address, process.stderr.read()
    yield Running(process, address)
    assert process.poll() is None, process.stderr.read()
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=30)
    assert "Traceback" not in error, error


def array_of(rng: np.random.Generator) -> Any:
    """An array as a message describes it, wrong in some way."""
    dtype = rng.choice(["|O", "<U4", "<c8", "<f4", "f4,f4", "S9999999999", "<f16", "x", "<i8"])
    sizes = [0, 1, 3, 12, 2**31, 2**62, -1, 2**63 - 1]
    shape = [int(rng.choice(sizes)) for _ in range(rng.integers(0, 12))]
    data = rng.bytes(int(rng.choice([0, 4, 48, 5000])))
    return {b"__ndarray__": True, b"dtype": str(dtype), b"shape": shape, b"data": data}


WRONG: list[Callable[[np.random.Generator], Any]] = [
    array_of,
    lambda rng: {b"__npgeneric__": True, b"dtype": "|u1", b"data": int(rng.integers(-9, 999))},
    lambda rng: "text" * int(rng.integers(0, 9999)),
    lambda rng: [[0] * 3] * int(rng.integers(0, 9999)),
    lambda rng: float(rng.choice([np.nan, np.inf, -np.inf, 1e308])),
    lambda rng: int(rng.choice([-1, 2**63 - 1, 0])),
    lambda rng: {"a": {"b": {}}},
    lambda rng: rng.normal(size=rng.integers(0, 6, size=rng.integers(0, 5))),
    lambda rng: rng.integers(0, 256, (rng.integers(0, 9), 3, 3), dtype=np.uint8),
    lambda rng: np.arange(10.0)[::-1],
]


def wrong_fields(rng: np.random.Generator, fields: dict[str, Any]) -> bytes:
    """A message of which some fields are wrong, missing or unknown."""
    names = [*fields, "prompt", "reset", "guide/chunk", "guide/weight", "images_time/View1"]
    names += ["images/left", "observation/state", "", "__class__", "x" * 300]
    changed = dict(fields)
    for name in rng.choice(names, rng.integers(1, 4)):
        changed[str(name)] = WRONG[rng.integers(len(WRONG))](rng)
    for name in rng.choice(list(fields), rng.integers(0, 3)):
        changed.pop(str(name), None)
    return wire.pack(changed)


def wrong_bytes(rng: np.random.Generator, fields: dict[str, Any]) -> bytes:
    """A good message cut short, with bytes turned or put into it."""
    data = bytearray(wire.pack(fields))
    if (kind := rng.integers(3)) == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        for place in rng.integers(0, min(len(data), 300), rng.integers(1, 20)):
            data[place] = rng.integers(256)
    else:
        place = rng.integers(300)
        data[place:place] = rng.bytes(int(rng.integers(1, 9)))
    return bytes(data)


def wrong_structure(rng: np.random.Generator, _: dict[str, Any]) -> bytes:
    """Lengths that are not there, levels without end, types that no message has."""
    heads = [b"\xdf", b"\xdd", b"\xc6", b"\xdb", b"\xc9", b"\xde", b"\xdc", b"\xda", b"\xc5"]
    length = struct.pack(">I", int(rng.choice([2**32 - 1, 2**31, 2**20, 20_001, 65_535])))
    deep = int(rng.choice([3, 13, 500, 1500, 200_000]))
    return [
        bytes(rng.choice(heads)) + length + rng.bytes(9),
        b"\x91" * deep + b"\xc0",
        b"\x81\xa1a" * deep + b"\xc0",
        msgpack.packb([[0] * 15_000] * int(rng.integers(1, 9))),
        msgpack.packb(msgpack.ExtType(int(rng.integers(0, 127)), rng.bytes(20))),
        rng.bytes(int(rng.integers(0, 5000))),
        b"\0" * (2**20 + 1),
    ][rng.integers(7)]


def over_a_socket(rng: np.random.Generator, address: str) -> None:
    """No handshake, or one and then frames that are none."""
    host, _, port = address.rpartition(":")
    hello = (
        f"GET / HTTP/1.1\r\nHost: {address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    ).encode()
    frames = [
        b"\x82\xff" + struct.pack(">Q", 2**62) + b"abcd",  # a length beyond all bounds
        b"\x82\xfe\xff\xff" + b"abcd" + b"x" * 100,  # never ends
        b"\x82\x05hello",  # not masked
        b"\x81\x82abcd\xff\xfe",  # a text that is none
        rng.bytes(200),
    ]
    starts = [hello, hello[:-2], hello.replace(b"GET", b"BREW"), b"\x16\x03\x01" + rng.bytes(99)]
    with suppress(OSError), socket.create_connection((host, int(port)), timeout=20) as stranger:
        start = starts[rng.choice(4, p=[0.7, 0.1, 0.1, 0.1])]
        stranger.sendall(start)
        if start is hello:
            stranger.recv(100)
            stranger.sendall(frames[rng.integers(len(frames))])
        if rng.random() < 0.2:  # else it leaves at once
            stranger.settimeout(0.02)
            stranger.recv(10)


def over_a_websocket(rng: np.random.Generator, address: str, fields: dict[str, Any]) -> bool:
    """Send a broken message, after a good one sometimes; whether it was refused."""
    kinds = [wrong_fields, wrong_bytes, wrong_structure]
    message: Any = kinds[rng.choice(3, p=[0.4, 0.35, 0.25])](rng, fields)
    if rng.random() < 0.05:
        message = "text" * int(rng.integers(0, 99))
    options: Any = {"compression": None, "max_size": None, "proxy": None}
    with connect(f"ws://{address}", **options) as bare:
        assert isinstance(bare.recv(20), bytes)
        try:
            if rng.random() < 0.2:
                bare.send(wire.pack(fields))
                assert isinstance(bare.recv(20), bytes)
            bare.send(message)
            answer = bare.recv(20)
            if isinstance(answer, bytes):
                assert np.isfinite(wire.unpack(answer)["actions"]).all()
                return False
            assert answer.startswith("refused: ") and "\n" not in answer, answer
            bare.recv(20)
            pytest.fail("the connection stays open")
        except ConnectionClosed as closed:
            assert closed.rcvd is not None and closed.rcvd.code in (1003, 1007, 1008, 1009)
        return True


@pytest.mark.parametrize(
    "messages", [50, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(3000)])]
)
def test_broken_messages(messages: int, running, observe) -> None:
    short = {"sensor": np.zeros((2, 1026), np.float32), "sensor_time": np.array([0.01, 0.02])}
    fields, refused, warm = observe(0, **short), 0, messages // 10
    with PolicyClient(f"ws://{running.address}", timeout_s=20) as good:
        before = (0.0, 0)
        for number in range(messages):
            rng = np.random.default_rng([number, 7])
            if rng.random() < 0.2:
                over_a_socket(rng, running.address)
                refused += 1
            else:
                refused += over_a_websocket(rng, running.address, fields)
            if number % 10 == 0:
                answer = good.infer(observe(number // 10))
                assert answer["actions"].shape == (4, 7)
            if number == warm:
                before = running.held()
        after = running.held()
        good.infer(observe(messages))
    assert refused > 0.7 * messages
    assert after[0] < before[0] + GROWTH_MB
    assert after[1] <= before[1] + 8  # strangers that just left
