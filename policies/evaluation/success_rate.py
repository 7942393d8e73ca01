"""How sure a success rate is."""

from dataclasses import dataclass
from math import sqrt


@dataclass(frozen=True)
class SuccessRate:
    """Successes among independent trials."""

    successes: int
    trials: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval (Wilson, 1927); honest at 0 and at 1, unlike p +- 2 sd."""
        z, n = 1.959963984540054, self.trials
        p = self.successes / n
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
        return max(0.0, centre - half), min(1.0, centre + half)

    def __str__(self) -> str:
        """Such as 49/50 [0.90, 1.00]."""
        low, high = self.interval
        return f"{self.successes}/{self.trials} [{low:.2f}, {high:.2f}]"
