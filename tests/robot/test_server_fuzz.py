"""Broken messages cost their connection: the server goes on, and neither memory nor files grow."""

import os
import re
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pipeline.robot import wire
from pipeline.robot.client import PolicyClient

GROWTH_MB = 24
"""Beyond what is held after the first messages."""


def held() -> tuple[float, int]:
    """The memory of this process in MB, and its open files."""
    (kilobytes,) = re.findall(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(kilobytes) / 1000, len(os.listdir("/proc/self/fd"))


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


def is_refused(rng: np.random.Generator, address: str, fields: dict[str, Any]) -> bool:
    """Send a broken message, after a good one sometimes; whether it was refused."""
    message = broken(rng, fields)
    with connect(f"ws://{address}", compression=None, max_size=None, proxy=None) as bare:
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
def test_broken_messages(messages: int, served_policy, serving, observe, capfd) -> None:
    served = served_policy()
    served.glance.passes = served.glance.instructions = type(
        "Forgetful", (list,), {"append": lambda *_: None}
    )()
    address = serving(served, max_message_mb=1, max_connections=64).address
    short = {"sensor": np.zeros((2, 1026), np.float32), "sensor_time": np.array([0.01, 0.02])}
    fields, refused, before = observe(0, **short), 0, (0.0, 0)
    with PolicyClient(f"ws://{address}", timeout_s=20) as good:
        for number in range(messages):
            refused += is_refused(np.random.default_rng([number, 7]), address, fields)
            if number % 10 == 0:
                assert good.infer(observe(number // 10))["actions"].shape == (4, 7)
            if number == messages // 10:
                before = held()
        after = held()
        good.infer(observe(messages))
    assert refused > 0.7 * messages
    assert after[0] < before[0] + GROWTH_MB
    assert after[1] <= before[1] + 8  # strangers that just left
    assert "Traceback" not in capfd.readouterr().err
