"""The policy server: openpi's protocol over a websocket, and a page that shows how it goes.

A connection is one robot: it gets the metadata, then an answer to each observation, in order. What
is wrong with a message costs its connection only. One line of text says what went wrong, before the
connection is closed: `refused: …`, `error: …`; after `busy: …` it stays open.
"""

import asyncio
import hmac
import ipaddress
import logging
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import partial
from http import HTTPStatus
from itertools import count
from time import perf_counter
from typing import Final
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from pipeline.base.config import ServeParams
from pipeline.base.errors import ConfigError, ObservationError, PipelineError, WireError
from pipeline.robot import wire
from pipeline.robot.session import ServedPolicy, Session
from pipeline.robot.status import ServerStatus, page

TOKEN_VARIABLE: Final = "VLA_SERVE_TOKEN"
CLOSING_S: Final = 30.0
"""How long an observation under way may keep the server from closing."""
_GOING_AWAY, _TEXT, _BROKEN, _REFUSED, _FAILED = 1001, 1003, 1007, 1008, 1011
_SHARED: Final = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def read_token(params: ServeParams) -> str | None:
    """The token of `serve.token_file`, else of the environment, else none.

    Raises `ConfigError` for an empty one, and where the host asks for one and there is none.
    """
    token, place = os.environ.get(TOKEN_VARIABLE), TOKEN_VARIABLE
    if params.token_file is not None:
        place = f"serve.token_file: {params.token_file}"
        try:
            token = params.token_file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{place}: expected a token, found no such file: {error}") from None
    if token is not None:
        token = token.strip()
        if not token or not token.isascii():
            raise ConfigError(f"{place}: expected a token of ASCII characters, found none")
    elif not _is_loopback(params.host):
        raise ConfigError(
            f"serve.host: {params.host} can be reached by other machines, so a token is expected, "
            "found none. Write one (openssl rand -hex 32) into a file that only you can read, name "
            f"it as serve.token_file or set {TOKEN_VARIABLE}, and give robots the same"
        )
    return token


def listen(params: ServeParams) -> socket.socket:
    """A socket at `serve.host` and `serve.port`, not yet listening.

    Raises `ConfigError` where the address is not this machine's, or is taken.
    """
    with ExitStack() as undo:
        try:
            known = socket.getaddrinfo(params.host, params.port, type=socket.SOCK_STREAM)
            family, kind, protocol, _, address = min(known, key=lambda entry: entry[0])
            bound = undo.enter_context(socket.socket(family, kind, protocol))
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
        except OSError as error:
            raise ConfigError(
                f"serve.port: {params.host}:{params.port} cannot be listened on: {error.strerror}. "
                "Give an address of this machine as serve.host, and a port that is free (0 takes "
                "one)"
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
        """`bound` is what `listen` gave, `token` what `read_token` did."""
        self._served, self._params, self._token, self._say = served, params, token, say
        self._socket = bound
        host, port = bound.getsockname()[:2]
        self.address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.status = ServerStatus(served.metadata)
        # A thread a robot, for each has at most one observation under way.
        self._threads = ThreadPoolExecutor(params.max_connections, "robot")
        self._numbers, self._answering = count(1), 0
        self._idle: set[ServerConnection] = set()
        self._stopping = False
        self._stop: Callable[[], object] = lambda: None

    def run(self, started: Callable[[], None] = lambda: None) -> bool:
        """Serve; whether a signal ended it. `started` is called once connections are taken."""
        try:
            return asyncio.run(self._run(started))
        finally:
            self._threads.shutdown()

    def stop(self) -> None:
        """Have `run` end, from any thread, once it has begun: what is under way is answered."""
        with suppress(RuntimeError):  # it has ended
            self._stop()

    async def _run(self, started: Callable[[], None]) -> bool:
        loop, ended, signals = asyncio.get_running_loop(), asyncio.Event(), list[int]()
        self._stop = lambda: loop.call_soon_threadsafe(ended.set)

        def catch(number: int) -> None:
            signals.append(number)
            ended.set()

        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, catch, number)
        # Handshakes of strangers that fail are no news.
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
        await ended.wait()
        await self._close(server)
        return bool(signals)

    async def _close(self, server: Server) -> None:
        """No new connections, an answer to each observation under way, then 1001."""
        self._stopping = True
        server.close(close_connections=False)
        if self._answering:
            self._say(f"stopping once {self._answering} observations are answered")
        await asyncio.gather(*(_leave(connection) for connection in self._idle))
        try:
            async with asyncio.timeout(CLOSING_S):
                await server.wait_closed()
        except TimeoutError:
            self._say(f"an observation took more than {CLOSING_S:.0f} s and is not answered")

    async def _converse(self, connection: ServerConnection) -> None:
        """One robot, from its metadata to its last answer."""
        number = next(self._numbers)
        with self.status.connected(number, str(connection.remote_address[0])):
            try:
                await connection.send(wire.pack(self._served.metadata))
                session = self._served.session(self._params.fresh, self._params.seed)
                while not self._stopping:
                    if not await self._answer_next(number, connection, session):
                        return
                await _leave(connection)
            except ConnectionClosed:
                pass
            finally:
                self._idle.discard(connection)

    async def _answer_next(
        self, number: int, connection: ServerConnection, session: Session
    ) -> bool:
        """Whether the conversation goes on after the next message."""
        self._idle.add(connection)
        try:
            async with asyncio.timeout(self._params.idle_s):
                message = await connection.recv()
        except TimeoutError:
            await connection.close(_REFUSED, f"nothing came for {self._params.idle_s:g} s")
            return False
        self._idle.discard(connection)
        said, code = await self._answer(number, message, session)
        del message
        await connection.send(said)
        if code is not None:
            self.status.refused += 1
            assert isinstance(said, str)
            await connection.close(code, said.encode()[:120].decode(errors="ignore"))
        return code is None

    async def _answer(
        self, number: int, message: str | bytes, session: Session
    ) -> tuple[str | bytes, int | None]:
        """What is said to a message, and the code to close the connection with, None to go on."""
        if isinstance(message, str):
            return "refused: expected a message of bytes (msgpack), found a text", _TEXT
        busy = self._answering >= self._params.max_waiting
        self._answering += 1
        think = partial(self._think, number, message, session, busy)
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, think), None
        except (WireError, ObservationError) as error:
            code = _BROKEN if isinstance(error, WireError) else _REFUSED
            return f"refused: {_line(error)}", code
        except PipelineError as error:
            return f"error: {_line(error)}", _FAILED
        except Exception as error:
            traceback.print_exception(error, file=sys.stderr)
            return f"error: {type(error).__name__}: the server's output says more", _FAILED
        finally:
            self._answering -= 1

    def _think(self, number: int, message: bytes, session: Session, busy: bool) -> str | bytes:
        """The answer to a message, in a thread of its own."""
        began = perf_counter()
        observation = session.take(wire.unpack(message, self._params.max_message_mb * 2**20))
        if busy:
            self.status.busy += 1
            return (
                f"busy: {self._params.max_waiting} observations are waiting. The readings were "
                "taken, send the next observation"
            )
        answer = session.answer(observation)
        key, timing = answer.get("feature_key"), answer["server_timing"]
        timing["infer_ms"] = 1000 * (perf_counter() - began)
        self.status.answered(number, observation, answer)
        # Bytes, not an array: openpi's chunk broker takes every array for one of steps.
        sent = answer if key is None else answer | {"feature_key": key.tobytes()}
        return wire.pack(sent)

    async def _respond(self, _: ServerConnection, request: Request) -> Response | None:
        """The answer to a request by HTTP; None where it opens a websocket."""
        path = urlsplit(request.path).path
        if path == "/healthz":
            return _response(HTTPStatus.OK, "OK\n")
        if (refusal := self._refusal(request)) is not None:
            return refusal
        opens = _header(request.headers, "Upgrade").lower() == "websocket"
        if path == "/" and not opens:
            text, policy = page()
            shown = {"Content-Type": "text/html; charset=utf-8", "Content-Security-Policy": policy}
            return _response(HTTPStatus.OK, text, shown)
        if not self._authorized(request.headers):
            said = "expected the header Authorization: Api-Key <the server's token>\n"
            return _response(HTTPStatus.UNAUTHORIZED, said, {"WWW-Authenticate": "Api-Key"})
        if path == "/":
            return self._full()
        if path == "/status.json":
            text = await asyncio.to_thread(self.status.json)
            return _response(HTTPStatus.OK, text, {"Content-Type": "application/json"})
        return _response(HTTPStatus.NOT_FOUND, "not here: /, /healthz, /status.json\n")

    def _refusal(self, request: Request) -> Response | None:
        """Refuses pages of other places, which a browser on this machine would let in.

        Without a token that is also done by the name that the browser believes to talk to: another
        place's name can be made to mean this machine.
        """
        host, origin = (_header(request.headers, name) for name in ("Host", "Origin"))
        if "Origin" in request.headers and urlsplit(origin).netloc != host:
            return _response(HTTPStatus.FORBIDDEN, "pages of other places are not served\n")
        if self._token is None and not _is_loopback(urlsplit(f"//{host}").hostname or ""):
            return _response(HTTPStatus.FORBIDDEN, "without a token only localhost is served\n")
        return None

    def _full(self) -> Response | None:
        """Why no more websockets are opened; None where they are."""
        most = self._params.max_connections
        if len(self.status.robots) < most:
            return None
        said = f"busy: {most} robots are connected (serve.max_connections)\n"
        return _response(HTTPStatus.SERVICE_UNAVAILABLE, said)

    def _authorized(self, headers: Headers) -> bool:
        given = _header(headers, "Authorization").encode()
        return self._token is None or hmac.compare_digest(given, f"Api-Key {self._token}".encode())


def _header(headers: Headers, name: str) -> str:
    """The value of a header, empty where it is missing or there several times."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else ""


def _response(status: HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> Response:
    body = text.encode()
    all_headers = {"Content-Type": "text/plain; charset=utf-8", **_SHARED, **(headers or {})}
    all_headers |= {"Content-Length": str(len(body)), "Connection": "close"}
    return Response(status.value, status.phrase, Headers(all_headers), body)


async def _leave(connection: ServerConnection) -> None:
    await connection.close(_GOING_AWAY, "the server is stopping")


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _line(error: Exception) -> str:
    """What an error says, in one line that may be long."""
    return " ".join(str(error).split())[:2000]
