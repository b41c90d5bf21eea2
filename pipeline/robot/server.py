"""The policy server: openpi's protocol over a websocket; beside it `/healthz`, `/status.json`.

A connection is one robot: it gets the metadata, then an answer to each observation, in order. A
wrong message closes its own connection only, after one line of text that says why: `refused: …` or
`error: …`.
"""

import asyncio
import hmac
import ipaddress
import json
import logging
import math
import os
import re
import signal
import socket
import sys
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from http import HTTPStatus
from time import monotonic
from typing import Any, Final, Literal, cast

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from pipeline.base.config import ServeParams
from pipeline.base.documents import shown
from pipeline.base.errors import ConfigError, ObservationError, PipelineError, WireError
from pipeline.robot import wire
from pipeline.robot.client import TOKEN_VARIABLE
from pipeline.robot.observation import KEY_MAPS
from pipeline.robot.run_report import Timings, allowed_ms
from pipeline.robot.session import ServedPolicy, Session

CLOSING_S: Final = 30.0
"""How long an unanswered observation may keep the server from closing."""
_TURNED_AWAY: Final = (401, 403, 503)
"""Statuses of requests that are noted as turned away."""
Event = Literal[
    "connected", "left", "episode", "slow", "warning", "refused", "error", "turned away"
]
_REFUSALS: Final = ("refused", "error", "turned away")
_TIMED: Final = ("vlm_ms", "head_ms", "wait_ms", "infer_ms")
_TIMINGS: Final = 5000
"""Newest answers whose latencies are kept."""
_SHOWN: Final = 20
"""Newest refusals and warnings that `/status.json` lists."""


class ServerStatus:
    """Counts, latencies and events of a server. Any thread may call it.

    `say` writes the line of an event, as text or as JSON (`form`).
    """

    def __init__(
        self,
        metadata: Mapping[str, Any],
        say: Callable[[str], None],
        form: Literal["text", "json"] = "text",
    ) -> None:
        self._counts: Counter[Event] = Counter()
        shown = ("checkpoint", "step", "model_type", "action_hz", "feature_spec_digest")
        self._policy = {name: metadata[name] for name in shown}
        self._timings, self._since_s = Timings(_TIMED, _TIMINGS), monotonic()
        self._lock, self._say, self._form = threading.Lock(), say, form
        self._refusals, self._warnings = (deque[dict[str, str]](maxlen=_SHOWN) for _ in range(2))

    @property
    def connected(self) -> int:
        """The robots that are connected now."""
        return self._counts["connected"] - self._counts["left"]

    def answered(self, timing: Mapping[str, float]) -> None:
        """Note the `server_timing` of an answer; a part of 0 ms did not happen."""
        with self._lock:
            self._timings.note([timing[part] or math.nan for part in _TIMED])

    def note(self, event: Event, robot: str, text: str = "") -> None:
        """Count an event of the robot at this address, and write its line."""
        text = "".join(c if c.isprintable() else " " for c in text)  # a client forges no line
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        record = {"time": time, "event": event, "robot": robot, "text": text}
        with self._lock:
            self._counts[event] += 1
            if event in _REFUSALS:
                self._refusals.append(record)
            elif event == "warning":
                self._warnings.append(record)
        line = f"{time} {robot} {event}{': ' if text else ''}{text}"
        with suppress(OSError):  # a log that is full or gone stops no robot
            self._say(json.dumps(record) if self._form == "json" else line)

    def json(self) -> str:
        """The content of `/status.json`."""
        with self._lock:
            counts = {
                "connected": self.connected,
                "answered": self._timings.count,
                "refused": self._counts["refused"] + self._counts["error"],
            }
            document = {
                "policy": self._policy,
                "seconds": monotonic() - self._since_s,
                "counts": counts,
                "latency": self._timings.document(),
                "refusals": [*self._refusals],
                "warnings": [*self._warnings],
            }
        return json.dumps(document)


def read_token(params: ServeParams) -> str | None:
    """The token of `serve.token_file`, else of the environment, else None.

    Raises `ConfigError` for an empty token, and for a missing one if the host needs it.
    """
    token, file = os.environ.get(TOKEN_VARIABLE), params.token_file
    try:
        token = token if file is None else file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"serve.token_file: {file}: expected a token, found {error}") from None
    if token is not None:
        token = token.strip()
        if not token or not token.isascii():
            place = TOKEN_VARIABLE if file is None else f"serve.token_file: {file}"
            raise ConfigError(
                f"{place}: expected a token of ASCII characters, found none. Unset it to ask for "
                "none"
            )
    elif not _is_loopback(params.host):
        raise ConfigError(
            f"serve.host: {params.host} can be reached by other machines, so a token is expected, "
            "found none. Write one (openssl rand -hex 32) into a file that only you can read, name "
            f"it as serve.token_file or set {TOKEN_VARIABLE}, and give robots the same"
        )
    return token


def listen(params: ServeParams) -> socket.socket:
    """A socket at `serve.host` and `serve.port`, not yet listening.

    Raises `ConfigError` if the address is not one of this machine, or is taken.
    """
    with ExitStack() as undo:
        family = socket.AF_INET6 if ":" in params.host else socket.AF_INET
        bound = undo.enter_context(socket.socket(family))
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((params.host, params.port))
        except OSError as error:
            raise ConfigError(
                f"serve.port: {params.host}:{params.port}: {error.strerror}. Give an address of "
                "this machine as serve.host, and a port that is free (0 takes one)"
            ) from None
        undo.pop_all()
        return bound


class PolicyServer:
    """Serves a policy until `stop`, Ctrl-C or SIGTERM."""

    def __init__(
        self,
        served: ServedPolicy,
        params: ServeParams,
        token: str | None,
        bound: socket.socket,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """`bound` comes from `listen`, `token` from `read_token`."""
        self._served, self._params, self._token, self._say = served, params, token, say
        self._socket = bound
        host, port = bound.getsockname()[:2]
        self.address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.status = ServerStatus(served.metadata, say, params.log)
        self._key_map = None if params.transform is None else KEY_MAPS[params.transform]
        if self._key_map is not None:
            self._key_map.refuse_more(served.metadata["streams"]["views"])
        self._metadata = served.metadata | {"transform": params.transform}
        self._allowed_ms = allowed_ms(served.metadata["horizon"], served.metadata["action_hz"])
        # One thread a robot, which has at most one unanswered observation.
        self._threads = ThreadPoolExecutor(params.max_connections, "robot")
        self._idle: set[ServerConnection] = set()
        self._stopping = False
        self._stop: Callable[[], object] = lambda: None

    def run(self, started: Callable[[], None] = lambda: None) -> bool:
        """Serve, and call `started` once robots can connect; returns whether a signal ended it."""
        try:
            return asyncio.run(self._run(started))
        finally:
            self._threads.shutdown()

    def stop(self) -> None:
        """End `run` from any thread, once it has begun; received observations are answered."""
        with suppress(RuntimeError):  # it has ended already
            self._stop()

    async def _run(self, started: Callable[[], None]) -> bool:
        loop, signalled = asyncio.get_running_loop(), asyncio.Queue[bool]()
        self._stop = lambda: loop.call_soon_threadsafe(signalled.put_nowait, False)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, signalled.put_nowait, True)
        # Failed handshakes of strangers are not logged.
        quiet = logging.getLogger(f"{__name__}.websockets")
        quiet.setLevel(logging.CRITICAL + 1)
        server = await serve(
            self._converse,
            sock=self._socket,
            process_request=self._respond,
            compression=None,
            max_size=self._params.max_message_mb * 2**20,
            max_queue=1,
            close_timeout=5,
            server_header=None,
            logger=quiet,
        )
        started()
        by_signal = await signalled.get()
        await self._close(server)
        return by_signal

    async def _close(self, server: Server) -> None:
        """Refuse new connections, answer the observations received, then close with 1001."""
        self._stopping = True
        server.close(close_connections=False)
        await asyncio.gather(*(_leave(connection) for connection in self._idle))
        try:
            async with asyncio.timeout(CLOSING_S):
                await server.wait_closed()
        except TimeoutError:
            self._say(f"an observation took more than {CLOSING_S:.0f} s and is not answered")

    async def _converse(self, connection: ServerConnection) -> None:
        """One robot, from its metadata to its last answer."""
        robot, answers, since_s = _address(connection), 0, monotonic()
        try:
            # Counted until its last observation is answered, which may be after it has left.
            self.status.note("connected", robot)
            await connection.send(wire.pack(self._metadata))
            session = self._served.session(self._params.fresh, self._params.seed, self._key_map)
            code = None
            while code is None and not self._stopping:
                message = await self._next(connection)
                answer, code = await self._answer(message, session, robot)
                del message
                if isinstance(answer, str):
                    event, _, why = answer.partition(": ")
                    self.status.note(cast("Event", event), robot, why)
                answers += isinstance(answer, bytes)
                await connection.send(answer)
            if code is None:
                await _leave(connection)
            else:
                await connection.close(code)
        except (ConnectionClosed, TimeoutError):
            pass  # The robot has left, or sends nothing.
        finally:
            seconds = monotonic() - since_s
            self.status.note("left", robot, f"{answers} answers in {seconds:.1f} s")

    async def _next(self, connection: ServerConnection) -> str | bytes:
        """The next message; closes a connection that sends none."""
        self._idle.add(connection)
        try:
            async with asyncio.timeout(self._params.idle_s):
                return await connection.recv()
        except TimeoutError:
            why = f"nothing came for {self._params.idle_s:g} s"
            await connection.close(CloseCode.POLICY_VIOLATION, why)
            raise
        finally:
            self._idle.discard(connection)

    async def _answer(
        self, message: str | bytes, session: Session, robot: str
    ) -> tuple[str | bytes, int | None]:
        """The answer to a message, and the code to close the connection with; None to go on."""
        if isinstance(message, str):
            why = "refused: expected a message of bytes (msgpack), found a text"
            return why, CloseCode.UNSUPPORTED_DATA
        loop = asyncio.get_running_loop()
        try:
            work = (self._think, message, session, robot)
            return await loop.run_in_executor(self._threads, *work), None
        except WireError as error:
            return f"refused: {_line(error)}", CloseCode.INVALID_DATA
        except ObservationError as error:
            return f"refused: {_line(error)}", CloseCode.POLICY_VIOLATION
        except PipelineError as error:
            return f"error: {_line(error)}", CloseCode.INTERNAL_ERROR
        except Exception as error:
            traceback.print_exception(error, file=sys.stderr)
            why = f"error: {type(error).__name__}: the server's output says more"
            return why, CloseCode.INTERNAL_ERROR

    def _think(self, message: bytes, session: Session, robot: str) -> bytes:
        """The answer to a message, in a thread of its own."""
        observation = session.take(wire.unpack(message, self._params.max_message_mb * 2**20))
        if observation.reset:
            self.status.note("episode", robot, observation.prompt or "")
        answer = session.answer(observation)
        self.status.answered(answer["server_timing"])
        for warning in answer.get("warnings", ()):
            self.status.note("warning", robot, warning)
        if (spent_ms := answer["server_timing"]["infer_ms"]) > self._allowed_ms:
            half = f"half of a chunk is {self._allowed_ms:.0f} ms"
            self.status.note("slow", robot, f"an answer took {spent_ms:.0f} ms, {half}")
        if "feature_key" in answer:
            # Bytes, not an array: openpi's chunk broker indexes every array by step.
            answer["feature_key"] = answer["feature_key"].tobytes()
        return wire.pack(answer)

    async def _respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to an HTTP request; None where it opens a websocket."""
        path = request.path.partition("?")[0]

        def respond(status: HTTPStatus, text: str, kind: str = "text/plain") -> Response:
            if status in _TURNED_AWAY:
                self.status.note("turned away", _address(connection), text)
            response = connection.respond(status, f"{text}\n")
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = kind
            return response

        if path == "/healthz":
            return respond(HTTPStatus.OK, "OK")
        if "Origin" in request.headers:
            return respond(HTTPStatus.FORBIDDEN, "web pages are not served")
        if self._token is None and not _is_loopback(name := _host(request)):
            why = f"expected Host localhost, found {shown(name)}: other names need a token"
            return respond(HTTPStatus.FORBIDDEN, why)
        if not self._is_authorized(request):
            why = "expected the header Authorization: Api-Key <the server's token>"
            return respond(HTTPStatus.UNAUTHORIZED, why)
        if path == "/status.json":
            return respond(HTTPStatus.OK, self.status.json(), "application/json")
        if path != "/":
            why = "expected a websocket at /, /healthz or /status.json"
            return respond(HTTPStatus.NOT_FOUND, why)
        if self.status.connected >= (most := self._params.max_connections):
            why = f"{most} robots are connected, as many as serve.max_connections allows"
            return respond(HTTPStatus.SERVICE_UNAVAILABLE, why)
        return None

    def _is_authorized(self, request: Request) -> bool:
        if self._token is None:
            return True
        given = ",".join(request.headers.get_all("Authorization")).encode(errors="replace")
        return hmac.compare_digest(given, f"Api-Key {self._token}".encode())


def _host(request: Request) -> str:
    """The name in `Host`, which a web page can make to point to this machine."""
    named = re.fullmatch(r"\[?(.*?)\]?(:\d+)?", ",".join(request.headers.get_all("Host")))
    return named[1] if named else ""


def _address(connection: ServerConnection) -> str:
    host, port, *_ = connection.remote_address or ("unknown", 0)
    return f"{host}:{port}"


async def _leave(connection: ServerConnection) -> None:
    await connection.close(CloseCode.GOING_AWAY, "the server is stopping")


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _line(error: Exception) -> str:
    """The message of an error in one line."""
    return " ".join(str(error).split())[:2000]
