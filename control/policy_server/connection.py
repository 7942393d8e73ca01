"""Connection to a policy server by openpi's protocol: msgpack over a websocket.

Arrays are maps of four byte strings, as in `openpi_client.msgpack_numpy` 0.1.2; the package
msgpack-numpy has other names.
"""

import weakref
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import connect

from touchgoal.runtime.errors import UserError

_CONNECT_TIMEOUT = 5.0  # s
_CLOSE_TIMEOUT = 1.0  # s
_ANSWER_TIMEOUT = 60.0  # s; the first answer may compile. An arm holds, and stops, long before.


class Connection:
    """A connection whose server has sent its metadata."""

    def __init__(self, url: str) -> None:
        """Connect; UserError if no policy server answers."""
        self._url, opened = url, ExitStack()
        weakref.finalize(self, opened.close)
        try:
            # openpi's server answers no ping while it computes; messages with images are large.
            options: Any = {"compression": None, "max_size": None, "ping_interval": None}
            options |= {"open_timeout": _CONNECT_TIMEOUT, "close_timeout": _CLOSE_TIMEOUT}
            self._socket = opened.enter_context(connect(url, **options))
            unpack(self._socket.recv(_CONNECT_TIMEOUT))
        except (OSError, ValueError, TypeError, WebSocketException) as error:
            raise UserError(f"no policy server answers at {url}: {error}") from error

    def infer(self, observation: dict[str, Any]) -> Any:
        """Return the answer to an observation; UserError if the server fails."""
        try:
            self._socket.send(pack(observation))
            answer = self._socket.recv(_ANSWER_TIMEOUT)
        except TimeoutError:
            raise UserError(f"{self._url} gave no answer in {_ANSWER_TIMEOUT:.0f} s") from None
        except ConnectionClosed as error:
            raise UserError(f"{self._url} closed the connection: {error}") from error
        if isinstance(answer, str):  # a traceback
            raise UserError(f"{self._url} failed: {answer.strip().splitlines()[-1]}")
        return unpack(answer)


def _array_to_map(array: np.ndarray) -> dict[bytes, Any]:
    data, kind = array.tobytes(), array.dtype.str
    return {b"__ndarray__": True, b"data": data, b"dtype": kind, b"shape": array.shape}


def _map_to_array(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.ndarray(value[b"shape"], np.dtype(value[b"dtype"]), value[b"data"])
    return value[b"data"] if b"__npgeneric__" in value else value  # a scalar


pack: Callable[[Any], bytes] = partial(msgpack.packb, default=_array_to_map)  # pyright: ignore
unpack: Callable[[Any], Any] = partial(msgpack.unpackb, object_hook=_map_to_array)
