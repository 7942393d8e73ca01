"""Pickles of others: plain values are read, anything else is refused without running it."""

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.runtime.errors import UserError

VALUE = {
    "pictures": [bytes([i]) * (100 * i) for i in range(5)],
    "trajectories": {
        0: {"forces": np.arange(12.0).reshape(4, 3), "slip": np.array([True, False])},
        1: {"forces": np.asfortranarray(np.arange(6, dtype=">f4").reshape(2, 3)), "slip": []},
    },
    "plain": [None, True, -1, 70_000, 2**40, 0.5, "wörter", (), (1, 2, 3, "vier")],
    "of numpy": [np.float64(2.5), np.bool_(True), np.int32(-7), np.bytes_(b"mug"), np.str_("mug")],
}


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_plain_values_are_read(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "values.pkl"
    path.write_bytes(pickle.dumps(VALUE, protocol))
    assert repr(read_plain_pickle(path)) == repr(pickle.loads(path.read_bytes()))
    # numpy 1 named its core differently
    path.write_bytes(pickle.dumps(np.arange(3.0), 3).replace(b"numpy._core.", b"numpy.core."))
    assert np.array_equal(read_plain_pickle(path), np.arange(3.0))


class Hostile:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch /tmp/it_ran",)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pickle.dumps(Hostile()), r"asks for posix\.system"),
        (pickle.dumps(Hostile(), 2), r"asks for posix\.system"),
        (pickle.dumps([print]), r"asks for builtins\.print"),
        (pickle.dumps(OrderedDict()), r"asks for collections\.OrderedDict"),
        (b"\x80\x03(ios\nsystem\n.", r"asks for os\.system"),
        (b"\x80\x04\x8c\x02o\n\x8c\x06system\x93.", r"asks for o\\n\.system"),
        (b"", "no pickle of plain values"),
        (b"\xff\xd8\xff\xe0 no pickle", "no pickle of plain values"),
        (pickle.dumps(VALUE)[:-30], "damaged"),
        (pickle.dumps(VALUE) + b"more", "damaged"),
        (b"\x80\x04\x8e" + b"\xff" * 8 + b".", "damaged"),
    ],
)
def test_anything_else_is_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "theirs.pkl"
    path.write_bytes(data)
    with pytest.raises(UserError, match=message) as refused:
        read_plain_pickle(path)
    assert "\n" not in str(refused.value)
    assert not Path("/tmp/it_ran").exists()


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.pkl", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            read_plain_pickle(path)
