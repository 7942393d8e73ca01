"""Curves of a training where people watch them: TensorBoard, Weights & Biases, Trackio, by Accelerate's trackers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from touchgoal.runtime.errors import UserError, unknown_name

_PROJECT = "touchgoal"  # in which online trackers list the run


def check_trackers(names: Sequence[str]) -> None:
    """Raise UserError if there is no such tracker, or its package is missing."""
    from accelerate import tracking  # slow to import

    available = {str(tracker) for tracker in tracking.get_available_trackers()}
    for name in names:
        if name not in tracking.LOGGER_TYPE_TO_CLASS:
            raise unknown_name("tracker", name, tracking.LOGGER_TYPE_TO_CLASS)
        if name not in available:
            raise UserError(f"--log-with {name}: pip install {name.replace('_', '-')}")


class Trackers:
    """Trackers of one run; `close` ends them."""

    def __init__(
        self, names: Sequence[str], folder: Path, config: Mapping[str, Any], device: str
    ) -> None:
        """Open the trackers with these names of Accelerate's, such as "tensorboard" or "wandb".

        What a tracker writes on this machine goes into `folder`, whose name is the run's; `config` is
        shown beside the curves. UserError: see `check_trackers`.

        Args:
            device: on which this process trains: the first use of Accelerate fixes it.
        """
        from accelerate import PartialState, tracking  # slow to import

        check_trackers(names)
        PartialState(cpu=device == "cpu")  # which trackers ask whether this is the first process
        self._open = []
        for name in names:
            kind, local = tracking.LOGGER_TYPE_TO_CLASS[name], name == "tensorboard"
            options: dict[str, Any] = (
                {"logging_dir": folder} if kind.requires_logging_directory else {}
            )
            if name in ("wandb", "trackio"):
                options["name"] = folder.resolve().name
            if name == "wandb":
                options["dir"] = folder
            tracker = kind("" if local else _PROJECT, **options)
            tracker.start()
            if not local:  # whose table of configurations takes numbers alone
                tracker.store_init_configuration(dict(config))
            self._open.append(tracker)

    def log(self, values: Mapping[str, float | None], step: int) -> None:
        """Add the values of a step, counted from 1; those that are None are left out."""
        known = {name: value for name, value in values.items() if value is not None}
        for tracker in self._open:
            tracker.log(known, step=step)

    def close(self) -> None:
        """End the trackers."""
        for tracker in self._open:
            tracker.finish()
