"""The client of the policy server, for the robot's computer: numpy, msgpack and websockets."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from typing import Any, Final

import numpy as np
from websockets import CloseCode
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from pipeline.base.differences import describe, differences
from pipeline.base.errors import CheckpointMismatch, ObservationError, ServerError
from pipeline.robot import wire

TOKEN_VARIABLE: Final = "VLA_SERVE_TOKEN"
"""The environment variable with the token."""


class PolicyClient(AbstractContextManager["PolicyClient"]):
    """One robot's connection to a policy server, which keeps a memory of this robot.

    Close it, or use it in a `with` statement. Raises `ServerError`, and `ObservationError` where
    the server refuses an observation.
    """

    metadata: Mapping[str, Any]
    """The policy's metadata: streams with names and units, rates, horizon, feature spec."""

    def __init__(
        self,
        url: str = "ws://127.0.0.1:8000",
        token: str | None = None,
        robot: Mapping[str, Any] | None = None,
        timeout_s: float = 10.0,
    ) -> None:
        """Connect; `timeout_s` bounds the connection and each answer.

        `robot` describes the robot, as far as it is known: names by `state`, `sensor`, `action`,
        their `…_units`, `action_kind`, `views`, `action_hz`. Raises `ServerError` where nobody
        listens or the token is wrong, `CheckpointMismatch` where the policy was trained on another
        robot.
        """
        self._url = url if "://" in url else f"ws://{url}"
        if not self._url.startswith(("ws://", "wss://")):
            raise ServerError(f"{url}: expected an address such as ws://127.0.0.1:8000")
        self._timeout_s, self._reset = timeout_s, dict[str, bool | int]()
        self._leaving = ExitStack()
        self._connection = self._connected(token)
        try:
            self.metadata = wire.unpack(self._receive())
            refuse_other_robot(robot or {}, self.metadata)
        except Exception:
            self.close()
            raise

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to an observation, with `actions` (horizon, action).

        Raises `ObservationError` where the server refuses the observation, `ServerError` where the
        connection is lost or the answer is late. After either it is closed: make another client.
        """
        reset, self._reset = self._reset, {}
        answer = wire.unpack(self._receive(wire.pack({**observation, **reset})))
        if "feature_key" in answer:
            answer["feature_key"] = np.frombuffer(answer["feature_key"], np.uint8)
        return answer

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode with the next observation; `seed` seeds the policy's samples."""
        self._reset = {"reset": True if seed is None else seed}

    def close(self) -> None:
        """Leave the server."""
        self._leaving.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _connected(self, token: str | None) -> ClientConnection:
        headers = {"Authorization": f"Api-Key {token}"} if token else None
        try:
            connecting = connect(
                self._url,
                additional_headers=headers,
                compression=None,
                open_timeout=self._timeout_s,
                max_size=wire.MAX_BYTES,
                proxy=None,
            )
            return self._leaving.enter_context(connecting)
        except InvalidStatus as error:
            body = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(f"{self._url}: {error}: {body:.300}") from None
        except (OSError, WebSocketException) as error:
            raise ServerError(
                f"{self._url}: nobody serves a policy there ({error}). Start python -m "
                "stages.serve, and give the address that it prints"
            ) from None

    def _receive(self, message: bytes | None = None) -> bytes:
        """The server's next message, after sending this one; a text is an error."""
        try:
            if message is not None:
                self._connection.send(message)
            answer = self._connection.recv(self._timeout_s)
        except TimeoutError:
            self.close()  # A late answer would be mistaken for the next one.
            raise ServerError(
                f"{self._url}: expected an answer within {self._timeout_s:g} s, found none, and "
                "left. Stop the robot; then connect again, with a longer timeout_s if the model is "
                "slow"
            ) from None
        except ConnectionClosed as error:
            self.close()
            why = (error.rcvd and error.rcvd.reason) or error
            if error.rcvd and error.rcvd.code == CloseCode.MESSAGE_TOO_BIG:
                why = f"{why}: send smaller images, or raise serve.max_message_mb"
            raise ServerError(
                f"{self._url}: the connection is closed ({why}), and what the server remembered of "
                "this robot is gone. Stop the robot; then connect again and begin a new episode"
            ) from None
        if isinstance(answer, bytes):
            return answer
        self.close()
        if answer.startswith("refused: "):
            raise ObservationError(answer.removeprefix("refused: "))
        raise ServerError(f"{self._url}: {answer}")


def refuse_other_robot(robot: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Raise `CheckpointMismatch` if the policy was trained on a robot other than this one.

    Only the entries of the description are compared; the robot may have further views.
    """
    streams = metadata["streams"]
    trained = {"views": streams["views"], "action_hz": metadata["action_hz"]}
    trained["action_kind"] = streams["action"]["kind"]
    for name in ("state", "sensor", "action"):
        stream = streams.get(name, {})
        trained |= {name: stream.get("names", ()), f"{name}_units": stream.get("units", ())}
    if unknown := sorted(robot.keys() - trained):
        raise CheckpointMismatch(
            f"the robot's description: expected {', '.join(trained)}, found {', '.join(unknown)}"
        )
    own = dict(robot)
    if "views" in robot:
        own["views"] = [view for view in trained["views"] if view in robot["views"]]
    if differing := differences({name: trained[name] for name in robot}, own):
        lines = describe(differing, " in training, the robot's ")
        raise CheckpointMismatch(
            "\n  ".join(["the policy was trained on another robot than this one:", *lines])
        )
