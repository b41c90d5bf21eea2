"""A client of the policy server, for the robot's computer: needs numpy, msgpack and websockets."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Final, NoReturn

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from pipeline.base.errors import CheckpointMismatch, ObservationError, ServerBusy, ServerError
from pipeline.robot import wire

_DESCRIBED: Final = {
    "state": ("state", "names"),
    "state_units": ("state", "units"),
    "sensor": ("sensor", "names"),
    "sensor_units": ("sensor", "units"),
    "action": ("action", "names"),
    "action_units": ("action", "units"),
    "action_kind": ("action", "kind"),
}
"""What a description of a robot may say of its streams, and where metadata says it."""


class PolicyClient:
    """One robot's connection to a policy server, which is one memory there.

    To be closed, or used in a `with` statement. Its errors are `ServerError`s; what the server
    finds wrong with an observation is an `ObservationError`.
    """

    metadata: Mapping[str, Any]
    """What is served: streams with names and units, rates, horizon, feature spec."""

    def __init__(
        self,
        url: str = "ws://127.0.0.1:8000",
        token: str | None = None,
        robot: Mapping[str, Any] | None = None,
        timeout_s: float = 10.0,
    ) -> None:
        """Connect; `timeout_s` is for the connection and for each answer.

        `robot` describes the own robot, as far as it is known: names by `state`, `sensor`,
        `action`, their `…_units`, `action_kind`, `views`, `action_hz`. Raises `ServerError` where
        nobody listens or the token is another, and `CheckpointMismatch` where the policy was
        trained on another robot than described.
        """
        self._url, self._token, self._robot = url, token, robot or {}
        self._timeout_s = timeout_s
        self._reset: bool | int | None = None
        self._connection: ClientConnection | None = None
        self._leaving = ExitStack()
        self.reconnect()

    def reconnect(self) -> None:
        """Connect anew, which begins a new episode: the server's memory of the last is gone."""
        self.close()
        self._connection = self._connected()
        try:
            self.metadata = wire.unpack(self._receive(self._timeout_s))
            refuse_other_robot(self._robot, self.metadata)
        except Exception:
            self.close()
            raise

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to an observation: `actions` (horizon, action), and what goes with it.

        Raises `ObservationError` where the server refuses it, `ServerBusy` where too many wait (the
        connection stays, and has taken the readings), `ServerError` where the connection is gone
        or the answer late: then `reconnect`.
        """
        if self._connection is None:
            raise ServerError(f"{self._url}: not connected; call reconnect")
        told = {} if self._reset is None else {"reset": self._reset}
        message = wire.pack({**observation, **told})
        try:
            self._connection.send(message)
        except ConnectionClosed as error:
            self._lose(error)
        try:
            answer = wire.unpack(self._receive(self._timeout_s))
        except ServerBusy:
            self._reset = None  # it is taken with the readings
            raise
        self._reset = None
        if "feature_key" in answer:
            answer["feature_key"] = np.frombuffer(answer["feature_key"], np.uint8)
        return answer

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode with the next observation; `seed` is of what the policy draws."""
        self._reset = True if seed is None else seed

    def close(self) -> None:
        """Leave the server."""
        self._connection = None
        self._leaving.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _connected(self) -> ClientConnection:
        headers = {"Authorization": f"Api-Key {self._token}"} if self._token else None
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
            said = (error.response.body or b"").decode(errors="replace").strip()
            hint = " Give the server's token." if error.response.status_code == 401 else ""
            raise ServerError(
                f"{self._url}: the server refuses the connection "
                f"({error.response.status_code}): {said:.300}.{hint}"
            ) from None
        except TimeoutError:
            raise ServerError(
                f"{self._url}: expected a connection within {self._timeout_s:g} s, found none. Is "
                "that a policy server? Look at its /healthz"
            ) from None
        except (OSError, WebSocketException) as error:
            raise ServerError(
                f"{self._url}: nobody serves a policy there ({error}). Start python -m "
                "stages.serve, and give the address that it prints"
            ) from None

    def _receive(self, timeout_s: float) -> bytes:
        """The next message of the server; what it says in words is an error."""
        assert self._connection is not None
        try:
            message = self._connection.recv(timeout_s)
        except TimeoutError:
            self.close()  # a late answer would be taken for the next
            raise ServerError(
                f"{self._url}: expected an answer within {timeout_s:g} s, found none, and left. "
                "Stop the robot; then reconnect, with a longer timeout_s if the model is slow"
            ) from None
        except ConnectionClosed as error:
            self._lose(error)
        if isinstance(message, bytes):
            return message
        if message.startswith("busy: "):
            raise ServerBusy(message)
        self.close()
        if message.startswith("refused: "):
            raise ObservationError(message.removeprefix("refused: "))
        raise ServerError(f"{self._url}: {message}")

    def _lose(self, error: ConnectionClosed) -> NoReturn:
        self.close()
        why = error.rcvd.reason if error.rcvd is not None else ""
        raise ServerError(
            f"{self._url}: the connection is lost ({why or error}), and with it what the server "
            "remembered. Stop the robot; then reconnect, which begins a new episode"
        ) from None


def refuse_other_robot(robot: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Raise `CheckpointMismatch` where a robot is not the one that a policy was trained on.

    Only what its description says is compared.
    """
    known = [*_DESCRIBED, "views", "action_hz"]
    if unknown := sorted(set(robot) - set(known)):
        raise CheckpointMismatch(
            f"the robot's description: expected {', '.join(known)}, found {', '.join(unknown)}"
        )
    streams, lines = metadata["streams"], list[str]()
    for name in (name for name in _DESCRIBED if name in robot):
        stream, of_it = _DESCRIBED[name]
        lines += _differences(name, streams.get(stream, {}).get(of_it, ()), robot[name])
    if missing := sorted(set(streams["views"]) - set(robot.get("views", streams["views"]))):
        lines.append(
            f"views: trained on {', '.join(streams['views'])}, the robot has no "
            f"{', '.join(missing)}"
        )
    if abs(robot.get("action_hz", metadata["action_hz"]) - metadata["action_hz"]) > 1e-6:
        lines.append(
            f"action_hz: trained {metadata['action_hz']}, the robot's {robot['action_hz']}"
        )
    if lines:
        raise CheckpointMismatch(
            "the policy was trained on another robot than this one:\n  " + "\n  ".join(lines)
        )


def _differences(name: str, trained: Sequence[str], own: Sequence[str]) -> list[str]:
    """A line where two lists of names, or two names, are not the same."""
    if isinstance(own, str) or isinstance(trained, str):
        return [] if trained == own else [f"{name}: trained {trained!r}, the robot's {own!r}"]
    if list(trained) == list(own):
        return []
    if len(trained) != len(own):
        return [f"{name}: trained on {len(trained)} channels, the robot has {len(own)}"]
    place = next(i for i, both in enumerate(zip(trained, own, strict=True)) if both[0] != both[1])
    order = " (the same in another order)" if sorted(trained) == sorted(own) else ""
    return [
        f"{name}: channel {place} trained {trained[place]!r}, the robot's {own[place]!r}{order}"
    ]
