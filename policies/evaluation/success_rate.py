"""Success rate with its confidence interval."""

from dataclasses import dataclass

from scipy.stats import binomtest


@dataclass(frozen=True)
class SuccessRate:
    """Successes among independent trials."""

    successes: int
    trials: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval (Wilson, 1927); honest at 0 and at 1, unlike p +- 2 sd."""
        interval = binomtest(self.successes, self.trials).proportion_ci(0.95, method="wilson")
        return float(interval.low), float(interval.high)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes}/{self.trials} [{low:.2f}, {high:.2f}]"
