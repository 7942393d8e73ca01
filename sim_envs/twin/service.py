"""Interface between the twin's loop and its services."""


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
