"""What a task of TacBench is to whatever trains and judges probes for it."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.benchmarks.tacbench.data import Rows
from touchgoal.benchmarks.tacbench.splits import Split

Outputs = Float[Tensor, "b k"]
ValidationOutputs = Float[Tensor, "v k"]
Targets = Float[Tensor, "b _"]
Metrics = dict[str, Any]
"""Numbers by name; one that is called NAME_interval has the 95 % interval of NAME over recordings."""


@runtime_checkable
class Task(Protocol):
    """One task, on one set of frames."""

    split: Split

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """What reads tokens (b t f) into outputs; random.

        Args:
            features: of a token.
            grid: rows and columns of the patches; the last tokens are theirs.
        """
        ...

    def targets(self, rows: Rows) -> Targets:
        """What a probe is to put out."""
        ...

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Of a probe's raw outputs."""
        ...

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """By which snapshots are compared on validation frames; less is better."""
        ...

    def judge(
        self, said: list[Outputs], validation: list[ValidationOutputs], rows: Rows
    ) -> Metrics:
        """Of training seeds together.

        Args:
            said: each seed's outputs of the frames `rows`.
            validation: each seed's outputs of the validation frames, to choose thresholds by.
            rows: of the test.
        """
        ...

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """What needs no encoder, by name."""
        ...
