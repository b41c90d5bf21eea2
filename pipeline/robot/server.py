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
from typing import Final
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers, MultipleValuesError
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from pipeline.base.config import ServeParams
from pipeline.base.errors import ConfigError, ObservationError, PipelineError, WireError
from pipeline.robot import wire
from pipeline.robot.client import TOKEN_VARIABLE
from pipeline.robot.session import ServedPolicy, Session
from pipeline.robot.status import ConnectedRobot, ServerStatus, page

CLOSING_S: Final = 30.0
"""How long an observation under way may keep the server from closing."""
_SHARED: Final = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def read_token(params: ServeParams) -> str | None:
    """The token of `serve.token_file`, else of the environment, else none.

    Raises `ConfigError` for an empty one, and where the host asks for one and there is none.
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

    Raises `ConfigError` where the address is not this machine's, or is taken.
    """
    with ExitStack() as undo:
        try:
            known = socket.getaddrinfo(params.host, params.port, type=socket.SOCK_STREAM)
            family, *_, address = min(known, key=lambda entry: entry[0])
            bound = undo.enter_context(socket.socket(family))
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
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
        """`bound` is what `listen` gave, `token` what `read_token` did."""
        self._served, self._params, self._token, self._say = served, params, token, say
        self._socket = bound
        host, port = bound.getsockname()[:2]
        self.address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.status = ServerStatus(served.metadata)
        # A thread a robot, for each has at most one observation under way.
        self._threads = ThreadPoolExecutor(params.max_connections, "robot")
        self._answering = 0
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
        loop, signalled = asyncio.get_running_loop(), asyncio.Queue[bool]()
        self._stop = lambda: loop.call_soon_threadsafe(signalled.put_nowait, False)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, signalled.put_nowait, True)
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
        by_signal = await signalled.get()
        await self._close(server)
        return by_signal

    async def _close(self, server: Server) -> None:
        """No new connections, an answer to each observation under way, then 1001."""
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
        peer = str(connection.remote_address[0])
        with self.status.connected(peer) as robot, suppress(ConnectionClosed, TimeoutError):
            await connection.send(wire.pack(self._served.metadata))
            session = self._served.session(self._params.fresh, self._params.seed)
            code = None
            while code is None and not self._stopping:
                message = await self._next(connection)
                said, code = await self._answer(robot, message, session)
                del message
                await connection.send(said)
            if code is None:
                await _leave(connection)
            else:
                self.status.refused += 1
                await connection.close(code)

    async def _next(self, connection: ServerConnection) -> str | bytes:
        """The next message; closes a connection from which none comes."""
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
        self, robot: ConnectedRobot, message: str | bytes, session: Session
    ) -> tuple[str | bytes, int | None]:
        """What is said to a message, and the code to close the connection with, None to go on."""
        if isinstance(message, str):
            said = "refused: expected a message of bytes (msgpack), found a text"
            return said, CloseCode.UNSUPPORTED_DATA
        loop, busy = asyncio.get_running_loop(), self._answering >= self._params.max_waiting
        asked = (robot, message, session, busy)
        self._answering += 1
        try:
            return await loop.run_in_executor(self._threads, self._think, *asked), None
        except WireError as error:
            return f"refused: {_line(error)}", CloseCode.INVALID_DATA
        except ObservationError as error:
            return f"refused: {_line(error)}", CloseCode.POLICY_VIOLATION
        except PipelineError as error:
            return f"error: {_line(error)}", CloseCode.INTERNAL_ERROR
        except Exception as error:
            traceback.print_exception(error, file=sys.stderr)
            said = f"error: {type(error).__name__}: the server's output says more"
            return said, CloseCode.INTERNAL_ERROR
        finally:
            self._answering -= 1

    def _think(
        self, robot: ConnectedRobot, message: bytes, session: Session, busy: bool
    ) -> str | bytes:
        """The answer to a message, in a thread of its own."""
        observation = session.take(wire.unpack(message, self._params.max_message_mb * 2**20))
        if busy:
            self.status.busy += 1
            waiting = self._params.max_waiting
            return f"busy: {waiting} observations are waiting; the readings were taken"
        answer = session.answer(observation)
        self.status.answered(robot, observation, answer)
        if "feature_key" in answer:
            # Bytes, not an array: openpi's chunk broker takes every array for one of steps.
            answer["feature_key"] = answer["feature_key"].tobytes()
        return wire.pack(answer)

    async def _respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request by HTTP; None where it opens a websocket."""
        headers, say = request.headers, partial(_response, connection)
        try:
            path, foreign = urlsplit(request.path).path, self._is_foreign(headers)
            authorized = self._authorized(headers)
            opens = path == "/" and headers.get("Upgrade", "").lower() == "websocket"
        except MultipleValuesError as error:
            return say(HTTPStatus.BAD_REQUEST, f"expected the header {error} once, found several\n")
        except ValueError as error:
            said = f"expected addresses in the path, Host and Origin, found one without: {error}\n"
            return say(HTTPStatus.BAD_REQUEST, said)
        if path == "/healthz":
            return say(HTTPStatus.OK, "OK\n")
        if foreign:
            return say(HTTPStatus.FORBIDDEN, "pages of other places are not served\n")
        if path == "/" and not opens:
            return say(HTTPStatus.OK, *page())
        if not authorized:
            said = "expected the header Authorization: Api-Key <the server's token>\n"
            return say(HTTPStatus.UNAUTHORIZED, said, {"WWW-Authenticate": "Api-Key"})
        if path == "/status.json":
            text = await asyncio.to_thread(self.status.json)
            return say(HTTPStatus.OK, text, {"Content-Type": "application/json"})
        if not opens:
            return say(HTTPStatus.NOT_FOUND, "not here: /, /healthz, /status.json\n")
        most = self._params.max_connections
        if len(self.status.robots) < most:
            return None
        said = f"busy: {most} robots are connected (serve.max_connections)\n"
        return say(HTTPStatus.SERVICE_UNAVAILABLE, said)

    def _is_foreign(self, headers: Headers) -> bool:
        """Whether a page of another place asks, which a browser on this machine would let in.

        Without a token that is also told by the name that the browser believes to talk to: another
        place's name can be made to mean this machine.
        """
        here = urlsplit(f"//{headers.get('Host', '')}")
        if "Origin" in headers and urlsplit(headers["Origin"]).netloc != here.netloc:
            return True
        return self._token is None and not _is_loopback(here.hostname or "")

    def _authorized(self, headers: Headers) -> bool:
        given = headers.get("Authorization", "").encode()
        return self._token is None or hmac.compare_digest(given, f"Api-Key {self._token}".encode())


def _response(
    connection: ServerConnection,
    status: HTTPStatus,
    text: str,
    headers: Mapping[str, str] = _SHARED,
) -> Response:
    response = connection.respond(status, text)
    for name, value in {**_SHARED, **headers}.items():
        response.headers.pop(name, None)
        response.headers[name] = value
    return response


async def _leave(connection: ServerConnection) -> None:
    await connection.close(CloseCode.GOING_AWAY, "the server is stopping")


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _line(error: Exception) -> str:
    """What an error says, in one line that may be long."""
    return " ".join(str(error).split())[:2000]
