"""Pickles of others: what Python's own reader says of plain values, one line of anything else."""

import os
import pickle
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchgoal.episodes.importers.plain_pickle import StoredBytes, read_plain_pickle
from touchgoal.runtime.errors import UserError

VALUE = {
    "pictures": [bytes([i]) * (100 * i) for i in range(5)],
    "trajectories": {
        0: {"forces": np.arange(12.0).reshape(4, 3), "slip": np.array([True, False])},
        1: {"forces": np.asfortranarray(np.arange(6, dtype=">f4").reshape(2, 3)), "slip": []},
    },
    "plain": [None, True, -1, 3, 70_000, 2**40, 0.5, "wörter", (), (1, 2), (1, 2, 3, "vier")],
    "of numpy": [np.float64(2.5), np.bool_(True), np.int32(-7), np.bytes_(b"mug"), np.str_("mug")],
    "empty": np.zeros((0, 3)),
    "point": np.array(7),
}


def as_python(value: Any) -> Any:
    """With bytes read, for comparison."""
    if isinstance(value, StoredBytes):
        return value.read()
    if isinstance(value, dict):
        return {key: as_python(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(as_python(item) for item in value)
    return value


def same(a: Any, b: Any) -> bool:
    """Types, dtypes and values."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())
    return a == b


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_plain_values_are_read_as_python_reads_them(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "values.pkl"
    path.write_bytes(pickle.dumps(VALUE, protocol))
    assert same(as_python(read_plain_pickle(path)), pickle.loads(path.read_bytes()))
    # as numpy 1 wrote them, whose core had another name
    path.write_bytes(pickle.dumps(np.arange(3.0), 3).replace(b"numpy._core.", b"numpy.core."))
    assert same(read_plain_pickle(path), np.arange(3.0))


class Hostile:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch /tmp/it_ran",)


INSTANCE = b"\x80\x03(ios\nsystem\n."


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (pickle.dumps(Hostile()), r"asks for posix\.system"),
        (pickle.dumps(Hostile(), 2), r"asks for posix\.system"),
        (pickle.dumps([print]), r"asks for builtins\.print"),
        (pickle.dumps(OrderedDict()), r"asks for collections\.OrderedDict"),
        (pickle.dumps(np.array([{}, None], object)), r"array of 'O8'"),
        (pickle.dumps(np.zeros(2, [("a", "f4")])), r"array of 'V4'"),
        (INSTANCE, r"asks for os\.system"),
        (b"\x80\x04\x8c\x02o\n\x8c\x06system\x93.", r"asks for o\\n\.system"),
        (b"\x80\x04\x8c\x03abcQ.", r"it holds b'Q' at byte 7"),
        (b"", "is empty"),
        (b"\xff\xd8\xff\xe0 no pickle", "no pickle of plain values"),
        (pickle.dumps(VALUE)[:-30], "damaged"),
        (pickle.dumps(VALUE) + b"more", "damaged"),
        (b"\x80\x04B\xff\xff\xff\x7f.", "damaged"),  # 2 GB announced
        (b"\x80\x04\x8e" + b"\xff" * 8 + b".", "damaged"),
        (b"\x80\x04}(" + b"(" * 1000 + b"t" * 1000 + b"Ku.", "damaged"),  # a tuple as a key
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_anything_else_is_one_line(tmp_path: Path, data: bytes, told: str) -> None:
    path = tmp_path / "theirs.pkl"
    path.write_bytes(data)
    with pytest.raises(UserError, match=told) as refused:
        read_plain_pickle(path)
    assert "\n" not in str(refused.value)
    assert not Path("/tmp/it_ran").exists()


def test_a_small_file_does_not_fill_the_memory(tmp_path: Path) -> None:
    """An array's bytes, named again and again, make a new array each time in Python's own reader."""
    size = 1000
    names = b"cnumpy.core.multiarray\n_reconstruct\nq\x00cnumpy\nndarray\nq\x01"
    dtype = b"cnumpy\ndtype\nX\x02\x00\x00\x00u1\x89\x88\x87Rq\x02"
    data = b"B" + struct.pack("<I", size) + bytes(size) + b"q\x03"
    array = (
        b"h\x00h\x01K\x00\x85C\x01b\x87R(K\x01M" + struct.pack("<H", size) + b"\x85h\x02\x89h\x03tb"
    )
    path = tmp_path / "bomb.pkl"
    path.write_bytes(b"\x80\x03](" + names + dtype + data + array + b"e.")
    assert read_plain_pickle(path)[-1].shape == (size,)
    path.write_bytes(b"\x80\x03](" + names + dtype + data + 100 * array + b"e.")
    assert len(pickle.loads(path.read_bytes())) == 104
    with pytest.raises(UserError, match="unpacks to more than it holds"):
        read_plain_pickle(path)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.pkl", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            read_plain_pickle(path)


def test_whatever_byte_is_wrong_it_is_read_or_refused(tmp_path: Path) -> None:
    data, path = bytearray(pickle.dumps(VALUE)), tmp_path / "values.pkl"
    rng = np.random.default_rng(0)
    refused = 0
    for at in rng.permutation(len(data))[:200]:
        broken = bytearray(data)
        broken[at] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        try:
            as_python(read_plain_pickle(path))
        except UserError:
            refused += 1
    assert refused > 0
