"""One machine's part of a recording, where machines share nothing but their number."""

import re
from dataclasses import dataclass
from pathlib import Path

from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class Shard:
    """Every `count`-th piece from `index` on; each stays there when more are asked for later."""

    index: int = 0
    count: int = 1

    def holds(self, piece: int) -> bool:
        """Return whether a piece, counted from 0, belongs to this shard."""
        return piece % self.count == self.index

    def require(self, piece: int, root: Path) -> None:
        """Raise UserError if a piece that is recorded in `root` belongs to another shard."""
        if not self.holds(piece):
            raise UserError(f"{root} holds another shard's episodes: give each shard its own --out")


WHOLE = Shard()


def parse_shard(text: str, pieces: int) -> Shard:
    """Return the shard of an option `--shard I/N`; UserError: no such shard, or more than pieces."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    index, count = (int(number) for number in match.groups()) if match else (0, 0)
    if index >= count:
        raise UserError(
            f"--shard {text}: give I/N with I from 0 to N - 1; of four: 0/4, 1/4, 2/4 and 3/4"
        )
    if count > pieces:
        raise UserError(
            f"--shard {text}: there is work for {pieces} shards: take at most I/{pieces}"
        )
    return Shard(index, count)
