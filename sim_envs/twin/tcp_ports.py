"""Base class of the twin's services, and TCP ports that are polled between two physics steps."""

import socket

_MOST_UNSENT = 1_000_000  # bytes a client may leave unread before it is cut off
_MOST_UNREAD = 300_000  # bytes it may send without making sense; a control script has 42,000


class Service:
    """A service for clients; its methods never block, and do nothing unless overridden."""

    def receive(self) -> None:
        """Take client messages, before a physics step."""

    def hold(self) -> None:
        """Serve clients in place of a step, while a lock-step twin's time stands."""

    def send(self) -> None:
        """Answer clients, after a physics step."""

    def close(self) -> None:
        """Free ports and files."""


class ClientConnection:
    """A client; bytes that it sent wait in `unread`."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        if sock.family == socket.AF_INET:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = sock
        self.unread, self._unsent = b"", b""
        self.open = True

    def fileno(self) -> int:
        """Return the descriptor, for `select`."""
        return self._socket.fileno()

    @property
    def host(self) -> str:
        """Address that it comes from."""
        return self._socket.getpeername()[0]

    def read(self) -> None:
        """Receive bytes that have arrived."""
        try:
            chunk = self._socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            chunk = b""
        self.unread += chunk
        self.open &= bool(chunk) and len(self.unread) <= _MOST_UNREAD

    def lines(self) -> list[str]:
        """Return whole lines that have arrived."""
        *lines, self.unread = self.unread.split(b"\n")
        return [line.decode(errors="replace").strip() for line in lines]

    def send(self, data: bytes) -> None:
        """Send bytes; buffer those that the client does not take yet."""
        self._unsent += data
        try:
            self._unsent = self._unsent[self._socket.send(self._unsent) :]
        except BlockingIOError:
            self.open &= len(self._unsent) < _MOST_UNSENT
        except OSError:
            self.open = False

    def close(self) -> None:
        """Hang up."""
        self._socket.close()
        self.open = False


class ListeningPort:
    """A listening port; `greeting` is sent to every client."""

    def __init__(self, host: str, port: int, greeting: bytes = b"") -> None:
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((host, port))
        self._socket.listen(8)
        self._socket.setblocking(False)
        self._greeting = greeting
        self.clients: list[ClientConnection] = []

    @property
    def port(self) -> int:
        """Port number."""
        return self._socket.getsockname()[1]

    def fileno(self) -> int:
        """Return the descriptor, for `select`."""
        return self._socket.fileno()

    def accept(self) -> ClientConnection | None:
        """Greet and return a new client, if there is one."""
        try:
            client = ClientConnection(self._socket.accept()[0])
        except BlockingIOError:
            return None
        client.send(self._greeting)
        return client

    def poll(self) -> list[ClientConnection]:
        """Accept new clients, receive from all, drop those who left."""
        if client := self.accept():
            self.clients.append(client)
        for client in self.clients:
            client.read()
            if not client.open:
                client.close()
        self.clients = [client for client in self.clients if client.open]
        return self.clients

    def drop_all(self) -> None:
        """Hang up on every client."""
        for client in self.clients:
            client.close()
        self.clients = []

    def close(self) -> None:
        """Hang up and stop listening."""
        self.drop_all()
        self._socket.close()
