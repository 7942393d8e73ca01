"""Pickles of published data sets, read without running what is in them.

Python's own unpickler, restricted to the names with which numpy writes arrays and numbers.
"""

import pickle
from pathlib import Path
from typing import Any, BinaryIO

from touchgoal.runtime.errors import UserError

_CORES = ("numpy.core", "numpy._core")  # before and since numpy 2
_NAMES = {("numpy", "ndarray"), ("numpy", "dtype")} | {
    (f"{core}.{module}", name)
    for core in _CORES
    for module, name in (
        ("multiarray", "_reconstruct"),
        ("multiarray", "scalar"),
        ("numeric", "_frombuffer"),
    )
}


class _Unpickler(pickle.Unpickler):
    def __init__(self, path: Path, file: BinaryIO) -> None:
        super().__init__(file)
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            asked = f"{module}.{name}".encode("unicode_escape").decode()[:100]
            raise UserError(f"{self._path} asks for {asked}, which is no plain value: not read")
        return super().find_class(module.replace(*_CORES), name)


def read_plain_pickle(path: Path) -> Any:
    """Return the value in a pickle of containers, numbers, text, bytes and numpy arrays.

    UserError: there is no such file, it is damaged, or it asks for anything else.
    """
    try:
        with path.open("rb") as file:
            value = _Unpickler(path, file).load()
            if file.read(1):
                raise ValueError("more than one value")
            return value
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:  # on damaged files the unpickler raises any error
        raise UserError(f"{path} is damaged, or no pickle of plain values: get it again") from error
