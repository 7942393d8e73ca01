"""The makers' client libraries that drive the arms, and how to install them."""

import importlib
import importlib.metadata
from dataclasses import dataclass
from typing import Any

from touchgoal.runtime.errors import UserError, install_extra


@dataclass(frozen=True)
class ClientLibrary:
    """A client library: its name on PyPI, and how to install it, for messages."""

    package: str
    install: str

    @property
    def version(self) -> str | None:
        """Installed version; None if it is not installed."""
        try:
            return importlib.metadata.version(self.package)
        except importlib.metadata.PackageNotFoundError:
            return None

    def load(self, module: str) -> Any:
        """Import one of its modules; UserError with how to install it if it is missing."""
        try:
            return importlib.import_module(module)
        except ImportError as error:
            raise UserError(
                f"the arm's client library {module} is missing: {self.install}"
            ) from error


FRANKY = ClientLibrary("franky-control", install_extra("franka"))
UR_RTDE = ClientLibrary(
    "ur-rtde", "pip install ur-rtde, with Python 3.12 or earlier (there is no wheel for later ones)"
)
