"""Cores of a Ray cluster, to which `--ray` connects."""

import logging
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.parallel.worker_pool import use_one_core

RETRIES = 3  # times that an item is computed again after its worker or its node died


@dataclass(frozen=True)
class RayCluster:
    """A cluster that this process is connected to; `ray` is the module."""

    ray: Any

    def cores(self) -> int:
        """Return the number of cores, which changes as nodes come and go."""
        return int(self.ray.cluster_resources().get("CPU", 1))

    def task(self, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Return what submits an item and returns the reference of its result.

        Ray retries after deaths, and computes a result again if it is lost with its node.
        """
        sent = self.ray.put(function)  # is sent once per node, not once per item
        task = self.ray.remote(num_cpus=1, max_retries=RETRIES)(_call)
        return lambda item: task.remote(sent, item)

    def result(self, reference: Any) -> Any:
        """Wait for a result; raise what the function raised, UserError if its workers died."""
        try:
            return reference.future().result()  # `ray.get` takes SIGTERM for Ctrl-C
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except self.ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[0]
            raise UserError(f"the cluster lost an item {RETRIES + 1} times: {reason}") from error


@contextmanager
def ray_cluster(address: str) -> Iterator[RayCluster]:
    """Connect to a cluster; at the end unfinished work of this process is dropped.

    UserError: Ray is not installed, or no cluster answers.
    """
    try:
        import ray
    except ImportError:
        raise UserError(f"--ray needs Ray: {install_extra('ray')}") from None
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"--ray {address}: {reason}; start a cluster by: ray start --head"
        ) from error
    signal.signal(signal.SIGTERM, on_sigterm)  # Ray's would end this process without a word
    try:
        yield RayCluster(ray)
    finally:
        ray.shutdown()


def _call(function: Callable[[Any], Any], item: Any) -> Any:
    use_one_core()
    return function(item)
