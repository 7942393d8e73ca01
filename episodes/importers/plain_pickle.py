"""Pickles that somebody else made, read without running them: containers, numbers, text, bytes, arrays.

A pickle is a program for a stack machine that may call anything. This machine has no calls: it knows
the opcodes by which Python 3 writes plain values (protocols 3 to 5, described in Python's
`pickletools`), and the few names by which numpy writes arrays and numbers, which it makes itself.
Bytes stay in the file until somebody reads them, so that a file of many gigabytes costs little.
"""

import os
import pickle
import re
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from touchgoal.runtime.errors import UserError

_MOST_STEPS = 5_000_000  # a list of pictures takes two each
_MOST_TEXT = 65_536  # bytes
_MOST_NAME = 256  # bytes
_MOST_AXES = 8
_NUMBERS = {pickle.BININT: "<i", pickle.BININT1: "<B", pickle.BININT2: "<H", pickle.BINFLOAT: ">d"}
_TEXTS = {pickle.SHORT_BINUNICODE: "<B", pickle.BINUNICODE: "<I", pickle.BINUNICODE8: "<Q"}
_BYTES = {pickle.SHORT_BINBYTES: "<B", pickle.BINBYTES: "<I", pickle.BINBYTES8: "<Q"} | {
    pickle.BYTEARRAY8: "<Q"
}
_PUTS = {pickle.BINPUT: "<B", pickle.LONG_BINPUT: "<I"}
_GETS = {pickle.BINGET: "<B", pickle.LONG_BINGET: "<I"}
_CONSTANTS = {pickle.NONE: None, pickle.NEWTRUE: True, pickle.NEWFALSE: False}
_TUPLES = {pickle.EMPTY_TUPLE: 0, pickle.TUPLE1: 1, pickle.TUPLE2: 2, pickle.TUPLE3: 3}
_DTYPE = re.compile(r"[biuf][1248]|[SU]\d{1,4}")
_DAMAGE = (
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    struct.error,
    MemoryError,
)


class _Name(Enum):
    """What of numpy a pickle may name."""

    ARRAY_TYPE = "numpy.ndarray"
    DTYPE = "numpy.dtype"
    NEW_ARRAY = "_reconstruct"
    SCALAR = "scalar"
    ARRAY_OF_BYTES = "_frombuffer"


_KNOWN = {
    ("numpy", "ndarray"): _Name.ARRAY_TYPE,
    ("numpy", "dtype"): _Name.DTYPE,
    **{
        (f"numpy.{core}.{module}", name.value): name
        for core in ("core", "_core")  # before and since numpy 2
        for module, name in (
            ("multiarray", _Name.NEW_ARRAY),
            ("multiarray", _Name.SCALAR),
            ("numeric", _Name.ARRAY_OF_BYTES),
        )
    },
}


@dataclass(frozen=True, slots=True)
class StoredBytes:
    """Bytes that are still in their file.

    Attributes:
        path: of the file.
        start: where they begin.
        size: how many they are.
    """

    path: Path
    start: int
    size: int

    def read(self) -> bytes:
        """The bytes; UserError if the file is gone or shorter by now."""
        try:
            with self.path.open("rb") as file:
                file.seek(self.start)
                data = file.read(self.size)
        except OSError as error:
            raise UserError(f"{self.path} cannot be read: {error.strerror}") from error
        if len(data) < self.size:
            raise UserError(f"{self.path} became shorter while it was read: get it again")
        return data


def read_plain_pickle(path: Path) -> Any:
    """The value in a pickle of plain values; bytes in it are `StoredBytes`.

    Keys of dictionaries are text or whole numbers. Arrays are of numbers, truth values or text, and
    take no more memory than the file has bytes.

    Raises:
        UserError: there is no such file, it is damaged, or it asks for anything else.
    """
    try:
        with path.open("rb") as file:
            return _Machine(path, file).run()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


@dataclass
class _DType:
    """A dtype that is being made: its byte order comes later."""

    code: str
    order: str = "|"

    def numpy(self) -> np.dtype[Any]:
        return np.dtype(self.order + self.code)


class _Machine:
    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file
        self._at, self._size = 0, os.fstat(file.fileno()).st_size
        self._stack: list[Any] = []
        self._below: list[list[Any]] = []  # stacks under marks
        self._memo: dict[int, Any] = {}
        self._copied = 0

    def run(self) -> Any:
        if not self._size:
            raise UserError(f"{self._path} is empty: get it again")
        try:
            for _ in range(_MOST_STEPS):
                code = self._take(1)
                if code == pickle.STOP:
                    (value,) = self._stack
                    if self._below or self._at < self._size:
                        raise ValueError("ends too early")
                    return value
                self._step(code)
        except UserError:
            raise
        except _DAMAGE as error:
            raise UserError(
                f"{self._path} is damaged at byte {self._at}, or no pickle of plain values: get it again"
            ) from error
        raise UserError(f"{self._path} holds more than {_MOST_STEPS} values: split it")

    def _step(self, code: bytes) -> None:
        if code in _CONSTANTS:
            self._stack.append(_CONSTANTS[code])
        elif code in _NUMBERS:
            self._stack.append(self._number(_NUMBERS[code]))
        elif code in _BYTES:
            self._stack.append(self._stored(self._number(_BYTES[code])))
        elif code in _TEXTS:
            self._stack.append(self._text(self._number(_TEXTS[code])))
        elif code == pickle.LONG1:
            self._stack.append(
                int.from_bytes(self._take(self._number("<B")), "little", signed=True)
            )
        elif code == pickle.MEMOIZE:
            self._memo[len(self._memo)] = self._stack[-1]
        elif code in _PUTS:
            self._memo[self._number(_PUTS[code])] = self._stack[-1]
        elif code in _GETS:
            self._stack.append(self._memo[self._number(_GETS[code])])
        elif code in _TUPLES:
            self._stack.append(tuple(self._pop(_TUPLES[code])))
        elif code in _ACTIONS:
            _ACTIONS[code](self)
        else:
            raise UserError(
                f"{self._path} is no pickle of plain values: it holds {code!r} at byte {self._at - 1}"
            )

    def _protocol(self) -> None:
        if not 2 <= self._number("<B") <= pickle.HIGHEST_PROTOCOL:
            raise ValueError("protocol")

    def _mark(self) -> None:
        self._below.append(self._stack)
        self._stack = []

    def _since_mark(self) -> list[Any]:
        found, self._stack = self._stack, self._below.pop()
        return found

    def _tuple(self) -> None:
        values = self._since_mark()
        self._stack.append(tuple(values))

    def _append(self) -> None:
        (value,) = self._pop(1)
        self._last(list).append(value)

    def _appends(self) -> None:
        values = self._since_mark()
        self._last(list).extend(values)

    def _set_item(self) -> None:
        self._fill(self._pop(2))

    def _set_items(self) -> None:
        self._fill(self._since_mark())

    def _fill(self, pairs: list[Any]) -> None:
        target = self._last(dict)
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if isinstance(key, np.integer):
                key = int(key)
            if type(key) not in (str, int) or key in target:
                raise TypeError("key")
            target[key] = value

    def _global(self) -> None:
        self._stack.append(self._find(*(self._line() for _ in range(2))))

    def _stack_global(self) -> None:
        module, name = self._pop(2)
        if not (isinstance(module, str) and isinstance(name, str)):
            raise TypeError("name")
        self._stack.append(self._find(module, name))

    def _instance(self) -> None:
        self._find(*(self._line() for _ in range(2)))
        raise TypeError("no class among the known names")

    def _find(self, module: str, name: str) -> _Name:
        if (module, name) not in _KNOWN:
            asked = f"{module}.{name}".encode("unicode_escape").decode()[:_MOST_NAME]
            raise UserError(
                f"{self._path} asks for {asked}, which plain values need not: nothing of it was run"
            )
        return _KNOWN[module, name]

    def _reduce(self) -> None:
        name, arguments = self._pop(2)
        if type(name) is not _Name or type(arguments) is not tuple:
            raise TypeError("call")
        if name is _Name.NEW_ARRAY:
            if arguments[0] is not _Name.ARRAY_TYPE:
                raise TypeError("array")
            self._stack.append(np.empty(0))
        elif name is _Name.DTYPE:
            if not _DTYPE.fullmatch(arguments[0]):
                raise UserError(
                    f"{self._path} holds an array of {arguments[0][:20]!r}, not of plain numbers"
                )
            self._stack.append(_DType(arguments[0]))
        elif name is _Name.SCALAR:
            dtype, stored = arguments
            self._stack.append(self._array(stored, dtype, ())[()])
        elif name is _Name.ARRAY_OF_BYTES:
            stored, dtype, shape, order = arguments
            self._stack.append(self._array(stored, dtype, shape, fortran=order == "F"))
        else:
            raise TypeError("call")

    def _build(self) -> None:
        (state,) = self._pop(1)
        target = self._stack[-1]
        if type(target) is _DType:
            if state[1] not in "<>|" or any(part is not None for part in state[2:5]):
                raise TypeError("dtype")
            target.order = state[1]
        elif type(target) is np.ndarray:
            _, shape, dtype, fortran, stored = state
            made = self._array(stored, dtype, shape, bool(fortran))
            known: Any = target  # in place, for the memo knows this one
            known.__setstate__((1, made.shape, made.dtype, bool(fortran), made.tobytes("A")))
        else:
            raise TypeError("state")

    def _array(self, stored: Any, dtype: Any, shape: Any, fortran: bool = False) -> np.ndarray:
        kind = dtype.numpy()
        if type(shape) is not tuple or len(shape) > _MOST_AXES or any(n < 0 for n in shape):
            raise ValueError("shape")
        if prod(shape) * kind.itemsize != stored.size:
            raise ValueError("size")
        self._copied += stored.size
        if self._copied > self._size:
            raise UserError(f"{self._path} unpacks to more than it holds: nothing of it was kept")
        data = bytearray(stored.read())
        if kind.kind == "U":
            letters = np.frombuffer(data, kind.byteorder + "u4").astype(np.uint32)
            if (
                (letters > sys.maxunicode) | (letters >> 11 == 0x1B)
            ).any():  # 1B: halves of letters
                raise ValueError("text")
        return np.ndarray(shape, kind, data, order="F" if fortran else "C")

    def _take(self, count: int) -> bytes:
        if count > self._size - self._at:  # before memory is set aside for it
            raise ValueError("cut off")
        self._at += count
        return self._file.read(count)

    def _number(self, kind: str) -> Any:
        return struct.unpack(kind, self._take(struct.calcsize(kind)))[0]

    def _stored(self, size: int) -> StoredBytes:
        start = self._at
        if size > self._size - start:
            raise ValueError("cut off")
        self._at = self._file.seek(start + size)
        return StoredBytes(self._path, start, size)

    def _text(self, size: int) -> str:
        if size > _MOST_TEXT:
            raise ValueError("too long a text")
        return self._take(size).decode()

    def _line(self) -> str:
        line = self._file.readline(_MOST_NAME)
        if not line.endswith(b"\n"):
            raise ValueError("name")
        self._at += len(line)
        return line[:-1].decode()

    def _pop(self, count: int) -> list[Any]:
        if count > len(self._stack):
            raise IndexError("stack")
        values = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return values

    def _last(self, kind: type[Any]) -> Any:
        if type(self._stack[-1]) is not kind:
            raise TypeError("container")
        return self._stack[-1]


_ACTIONS: dict[bytes, Callable[[_Machine], object]] = {
    pickle.PROTO: _Machine._protocol,
    pickle.FRAME: lambda machine: machine._number("<Q"),
    pickle.MARK: _Machine._mark,
    pickle.TUPLE: _Machine._tuple,
    pickle.EMPTY_LIST: lambda machine: machine._stack.append([]),
    pickle.EMPTY_DICT: lambda machine: machine._stack.append({}),
    pickle.APPEND: _Machine._append,
    pickle.APPENDS: _Machine._appends,
    pickle.SETITEM: _Machine._set_item,
    pickle.SETITEMS: _Machine._set_items,
    pickle.GLOBAL: _Machine._global,
    pickle.STACK_GLOBAL: _Machine._stack_global,
    pickle.INST: _Machine._instance,
    pickle.REDUCE: _Machine._reduce,
    pickle.BUILD: _Machine._build,
}
