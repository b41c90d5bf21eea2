"""Broken messages cost their connection: the server goes on, and neither memory nor files grow."""

import gc
import os
import re
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pipeline.base.config import ServeParams
from pipeline.robot import wire
from pipeline.robot.client import PolicyClient
from pipeline.robot.server import PolicyServer, listen
from pipeline.robot.session import ServedPolicy
from tests.robot.conftest import build_policy

GROWTH_MB = 24
"""Beyond what a server holds after its first messages."""


def serve(stderr: Path, told: Connection) -> None:
    """Serve, tell where, and tell after each SIGUSR1 that garbage is collected."""
    os.dup2(os.open(stderr, os.O_WRONLY | os.O_CREAT), 2)
    torch.set_num_threads(1)
    signal.signal(signal.SIGUSR1, lambda *_: told.send(gc.collect()))
    checkpoint, policy, glance = build_policy()
    nothing_kept: Any = type("Forgetful", (list,), {"append": lambda *_: None})()
    glance.passes = glance.instructions = nothing_kept
    params = ServeParams(port=0, max_message_mb=1, max_connections=64)
    served = ServedPolicy(checkpoint, policy, glance, "head")
    server = PolicyServer(served, params, None, listen(params))
    server.run(lambda: told.send(server.address))


@dataclass
class Running:
    """A server in a process of its own."""

    process: BaseProcess
    heard: Connection
    address: str

    def held(self) -> tuple[float, int]:
        """Its memory in MB once garbage is collected, and its open files."""
        assert self.process.pid is not None
        os.kill(self.process.pid, signal.SIGUSR1)
        self.heard.recv()
        place = Path("/proc") / str(self.process.pid)
        (kilobytes,) = re.findall(r"VmRSS:\s+(\d+) kB", (place / "status").read_text())
        return int(kilobytes) / 1000, len(os.listdir(place / "fd"))


@pytest.fixture
def running(fork_server: ForkServerContext, tmp_path: Path) -> Iterator[Running]:
    heard, told = fork_server.Pipe(duplex=False)
    stderr = tmp_path / "stderr"
    process = fork_server.Process(target=serve, args=(stderr, told))
    process.start()
    told.close()
    yield Running(process, heard, heard.recv())
    assert process.is_alive(), stderr.read_text()
    process.terminate()
    process.join(30)
    assert not process.is_alive() and "Traceback" not in stderr.read_text()


def wrong(rng: np.random.Generator) -> Any:
    """What no field may hold, or not this one."""
    array = {b"__ndarray__": True, b"dtype": "<f4", b"shape": [2**31, 2**62], b"data": b"0000"}
    number = {b"__npgeneric__": True, b"dtype": "|u1", b"data": int(rng.integers(-9, 999))}
    values = [array, number, "text" * 9999, [[0] * 3] * 9999, np.nan, -1, {"a": {"b": {}}}]
    return [*values, rng.normal(size=rng.integers(0, 6, size=4))][rng.integers(8)]


def broken(rng: np.random.Generator, fields: dict[str, Any]) -> Any:
    """A message with wrong or unknown fields, cut off, with bytes put in, or of another kind."""
    data, place = wire.pack(fields), rng.integers(300)
    names = [*fields, "prompt", "reset", "guide/chunk", "images_time/View1", "__class__", "x" * 300]
    return [
        wire.pack(fields | {str(name): wrong(rng) for name in rng.choice(names, 2)}),
        wire.pack(dict.fromkeys(fields, wrong(rng))),
        data[: rng.integers(len(data))],
        data[:place] + rng.bytes(9) + data[place:],
        b"\x91" * int(rng.choice([13, 1500, 200_000])) + b"\xc0",
        msgpack.packb([[0] * 15_000] * 9),
        b"\0" * (2**20 + 1),
        "text",
    ][rng.integers(8)]


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
    message = broken(rng, fields)
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
