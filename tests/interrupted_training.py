"""Trainings that are interrupted."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from touchgoal.encoders.training import trainer


@contextmanager
def killed_in_epoch(epoch: int) -> Iterator[None]:
    """Interrupt the training in this context as that epoch begins."""
    train_epoch: Callable = trainer._train_epoch

    def dies(*args):
        if args[-1] == epoch:
            raise KeyboardInterrupt
        return train_epoch(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "_train_epoch", dies)
        with pytest.raises(KeyboardInterrupt):
            yield
