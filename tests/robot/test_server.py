"""The server answers robots, in order, and what is wrong with one costs that one alone."""

import http.client
import json
import socket
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from pipeline.base.config import ServeParams
from pipeline.base.errors import ConfigError
from pipeline.robot import wire
from pipeline.robot.client import PolicyClient
from pipeline.robot.server import PolicyServer, listen, read_token
from tests.robot.conftest import Blocked


def get(server: PolicyServer, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
    connection = http.client.HTTPConnection(server.address, timeout=20)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), dict(answer.getheaders())
    finally:
        connection.close()


def client_of(server: PolicyServer, **options: Any) -> PolicyClient:
    return PolicyClient(f"ws://{server.address}", **options)


@contextmanager
def opened(server: PolicyServer, **options: Any) -> Generator[ClientConnection]:
    """A bare websocket that has got the metadata."""
    options |= {"compression": None, "max_size": None, "proxy": None}
    with connect(f"ws://{server.address}", **options) as bare:
        assert wire.unpack(bare.recv(20))["protocol"] == 1
        yield bare


def closing_code(bare: ClientConnection) -> int:
    """The code with which the server closes a connection, next."""
    with pytest.raises(ConnectionClosed) as closed:
        bare.recv(20)
    return closed.value.rcvd.code


def test_a_connection_is_one_memory_and_bit_for_bit_what_a_session_in_process_is(
    served_policy, serving, observe
):
    served = served_policy("flow_matching")
    server, here = serving(served, seed=3), served.session(seed=3)
    with client_of(server) as client, client_of(server) as other:
        assert client.metadata == served.metadata | {"transform": None}
        alone = [here.infer(observe(tick)) for tick in range(5)]
        for tick, own in enumerate(alone):
            there = client.infer(observe(tick))
            np.testing.assert_array_equal(there["actions"], own["actions"])
            np.testing.assert_array_equal(there["feature_key"], own["feature_key"])
            assert there["feature_age_s"] == own["feature_age_s"]
            assert there["actions"].flags.writeable
        for tick in range(2):
            theirs = other.infer(observe(tick))["actions"]
            np.testing.assert_array_equal(theirs, alone[tick]["actions"])


def test_observations_of_one_connection_are_answered_in_order(served_policy, serving, observe):
    with opened(serving(served_policy())) as bare:
        messages = [wire.pack(observe(tick)) for tick in range(7)]
        sending = threading.Thread(target=lambda: [bare.send(message) for message in messages])
        sending.start()
        ages = [wire.unpack(bare.recv(20))["feature_age_s"] for _ in range(7)]
        sending.join()
    np.testing.assert_allclose(ages, [0, 0.1, 0.2, 0, 0.1, 0.2, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("message", "said", "code"),
    [
        ("time", "refused: expected a message of bytes (msgpack), found a text", 1003),
        (b"\x91", "refused: expected a message in msgpack, found none", 1007),
        (wire.pack({"time": 0.1, "gripper": 1}), "refused: gripper: expected one of", 1008),
    ],
)
def test_what_is_wrong_with_a_message_costs_its_connection_only(
    served_policy, serving, observe, message, said, code
):
    server = serving(served_policy())
    with client_of(server) as good:
        good.infer(observe(0))
        with opened(server) as bare:
            bare.send(message)
            text = bare.recv(20)
            assert isinstance(text, str) and text.startswith(said) and "\n" not in text
            assert closing_code(bare) == code
        assert good.infer(observe(1))["actions"].shape == (4, 7)
    assert json.loads(server.status.json())["counts"]["refused"] == 1


def test_status_and_lines_say_what_happened(served_policy, serving, observe):
    server: Any = serving(served_policy(), log="json")
    with client_of(server) as client:
        client.reset()
        client.infer(observe(0, prompt="go\non"))
        client.infer(observe(1, state=np.zeros((1, 12)), state_time=[0.15]))
        shown = json.loads(get(server, "/status.json")[1])
        assert shown["counts"] == {"connected": 1, "answered": 2, "refused": 0}
        assert shown["policy"]["checkpoint"] == "models/head"
        for part in ("vlm_ms", "head_ms", "wait_ms", "infer_ms"):
            assert 0 < shown["latency"][part]["p50"] <= shown["latency"][part]["max"]
    with opened(server) as bare:
        bare.send(wire.pack({"gripper": 1}))
        bare.recv(20)
        assert closing_code(bare) == 1008
    assert get(server, "/status.json", Origin="http://elsewhere")[0] == 403
    _, text, headers = get(server, "/status.json")
    assert headers["Content-Type"] == "application/json"
    shown = json.loads(text)
    assert [(r["event"], r["text"].split(":")[0]) for r in shown["refusals"]] == [
        ("refused", "gripper"), ("turned away", "web pages are not served"),
    ]  # fmt: skip
    assert [w["text"].split(":")[0] for w in shown["warnings"]] == ["prompt", "state"]
    lines = [json.loads(line) for line in server.lines]
    events = [line["event"] for line in lines]
    assert events[:5] == ["connected", "episode", "warning", "warning", "left"]
    assert lines[1]["text"] == "go on" and lines[4]["text"].startswith("2 answers in ")
    assert {"refused", "turned away"} <= set(events)


def test_a_client_of_a_known_robot_is_answered(served_policy, serving, observe) -> None:
    served = served_policy()
    own = observe(0, state=np.arange(12.0), state_time=None, sensor=None, sensor_time=None)
    cameras = ("cam_high", "cam_left_wrist", "cam_right_wrist")
    views = [name for name in own if name.startswith("images/")]
    images = {c: np.moveaxis(own[v], -1, 0) for c, v in zip(cameras, views, strict=True)}
    with client_of(serving(served, transform="aloha")) as client:
        assert client.metadata["transform"] == "aloha"
        answer = client.infer({"images": images, "state": own["state"], "time": own["time"]})
    np.testing.assert_array_equal(answer["actions"], served.session().infer(own)["actions"])


def test_a_message_beyond_the_bound_is_not_read(served_policy, serving, observe) -> None:
    server = serving(served_policy(), max_message_mb=1)
    large = {"images/View1": np.zeros((600, 600, 3), np.uint8)}
    with (
        client_of(server) as client,
        pytest.raises(ConnectionError, match=r"serve\.max_message_mb"),
    ):
        client.infer(observe(0, **large))


def test_a_bug_is_said_in_one_line_and_told_in_full_here(served_policy, serving, observe, capfd):
    served = served_policy()

    def fail(*_: Any) -> torch.Tensor:
        raise KeyError("secret of the house")

    served.policy.act = fail
    with opened(serving(served)) as bare:
        bare.send(wire.pack(observe(0)))
        assert bare.recv(20) == "error: KeyError: the server's output says more"
        assert closing_code(bare) == 1011
    assert "secret of the house" in capfd.readouterr().err


def test_who_says_nothing_is_left(served_policy, serving) -> None:
    with opened(serving(served_policy(), idle_s=0.2)) as bare:
        assert closing_code(bare) == 1008


def test_the_token_is_asked_for(served_policy, serving, observe) -> None:
    server = serving(served_policy(), token="s3cret")
    for wrong in (None, "s3cre", "s3cretx", "é"):
        headers = {"Authorization": f"Api-Key {wrong}"} if wrong else {}
        assert get(server, "/status.json", **headers)[0] == 401
    for wrong in (None, "other"):
        with pytest.raises(ConnectionError, match=r"401.*the server's token"):
            client_of(server, token=wrong)
    with client_of(server, token="s3cret") as client:
        assert client.infer(observe(0))["actions"].shape == (4, 7)
    assert get(server, "/healthz")[0] == 200
    assert get(server, "/status.json", Authorization="Api-Key s3cret")[0] == 200


def test_web_pages_are_refused(served_policy, serving) -> None:
    server = serving(served_policy())
    for origin in ("null", f"http://{server.address}"):
        for path in ("/", "/status.json"):
            assert get(server, path, Origin=origin)[0] == 403
    # Names that a page made to point here; http.client sends the right one unasked.
    for host, status in (("elsewhere.org:80", 403), ("[::1]:80", 200), ("localhost", 200)):
        assert get(server, "/status.json", Host=host)[0] == status
    with pytest.raises(InvalidStatus, match="403"), opened(server, origin="https://example.org"):
        pass
    assert get(server, "/elsewhere")[0] == 404


def test_stopping_answers_what_is_under_way_and_takes_no_more(served_policy, serving, observe):
    served = served_policy()
    blocked = Blocked(served)
    server = serving(served)
    with opened(server) as idle, opened(server) as busy:
        busy.send(wire.pack(observe(0)))
        assert blocked.looking.wait(60)
        server.stop()
        assert closing_code(idle) == 1001
        with pytest.raises(ConnectionError, match="nobody serves a policy there"):
            client_of(server)
        blocked.go.set()
        assert wire.unpack(busy.recv(20))["actions"].shape == (4, 7)
        assert closing_code(busy) == 1001


def params(**changed: Any) -> ServeParams:
    return ServeParams.model_validate(changed)


def test_tokens(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("VLA_SERVE_TOKEN", raising=False)
    file = tmp_path / "token.txt"
    file.write_text(" abc\n")
    assert read_token(params()) is None
    assert read_token(params(host="::1")) is None
    for host in ("0.0.0.0", "::", "192.168.1.7", "robot.local"):
        with pytest.raises(ConfigError, match="can be reached by other machines"):
            read_token(params(host=host))
    assert read_token(params(host="0.0.0.0", token_file=file)) == "abc"
    monkeypatch.setenv("VLA_SERVE_TOKEN", "def")
    assert read_token(params(host="0.0.0.0")) == "def"
    assert read_token(params(token_file=file)) == "abc"
    for wrong, said in (("  \n", "ASCII"), ("é", "ASCII"), (None, "No such file")):
        file.unlink(missing_ok=True)
        if wrong is not None:
            file.write_text(wrong, encoding="utf-8")
        with pytest.raises(ConfigError, match=said):
            read_token(params(token_file=file))


def test_an_address_that_is_taken_or_somebody_elses_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=r"serve\.port: .*in use\. .*a port that is free"):
            listen(params(port=port))
    with pytest.raises(ConfigError, match=r"serve\.port: 192\.0\.2\.1"):
        listen(params(host="192.0.2.1"))


def test_a_robot_counts_until_its_observation_is_answered_though_it_has_left(
    served_policy, serving, observe
):
    """Or a stranger who comes and goes would fill the memory with observations that wait."""
    served = served_policy()
    blocked = Blocked(served)
    server = serving(served, max_connections=1)
    with opened(server) as bare:
        bare.send(wire.pack(observe(0)))
        assert blocked.looking.wait(60)
    with pytest.raises(ConnectionError, match=r"1 robots.*serve.max_connections"):
        client_of(server)
    blocked.go.set()
