"""A frozen network compiled for the CPU by OpenVINO: torch's numbers to about 1e-5, in 0.4 of the time."""

import os
import sys
import threading
import warnings
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.runtime.errors import wheel_folder


class CompiledNetwork:
    """Runs a network that takes one batch of images and returns a tuple of tensors.

    A call uses one core; calls from several threads run at the same time, up to the number of cores.
    It is compiled once for each size of images; the network must not change after that.
    """

    def __init__(self, network: nn.Module) -> None:
        """Take a network on the CPU, in evaluation mode; UserError if OpenVINO is missing."""
        wheel_folder("openvino")
        self._network = network
        self._compiled: dict[tuple[int, int], Any] = {}
        self._compiling, self._requests = threading.Lock(), threading.local()

    def __reduce__(self) -> tuple[type["CompiledNetwork"], tuple[nn.Module]]:
        """Copy and pickle the network alone, which the copy compiles itself."""
        return CompiledNetwork, (self._network,)

    def __call__(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """Return the network's outputs, on the CPU.

        Image by image, which stays in the processor's cache: 32 at once take 1.4 times as long.
        """
        request = self._request(*images.shape[2:])
        found = [request.infer([one.contiguous().numpy()]) for one in images.split(1)]
        outputs = range(len(found[0]))
        return tuple(torch.from_numpy(np.concatenate([f[i] for f in found])) for i in outputs)

    def _request(self, height: int, width: int) -> Any:
        """Return this thread's own request: a request runs once at a time."""
        mine = self._requests.__dict__.setdefault("by_size", {})
        if (height, width) not in mine:
            with self._compiling:
                if (height, width) not in self._compiled:
                    self._compiled[height, width] = _compile(self._network, height, width)
            mine[height, width] = self._compiled[height, width].create_infer_request()
        return mine[height, width]


@torch.no_grad()
def _compile(network: nn.Module, height: int, width: int) -> Any:
    # OpenVINO reports its use to its maker unless this is not there.
    sys.modules.setdefault("openvino_telemetry", None)  # pyright: ignore[reportArgumentType]
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sizes become constants, as they should
        traced = torch.jit.trace(network, torch.zeros(1, 3, height, width), check_trace=False)
    decoder = TorchScriptPythonDecoder(traced)  # must outlive the conversion
    frontend = FrontEndManager().load_by_framework("pytorch")
    model = frontend.convert(frontend.load(decoder))
    model.reshape([-1, 3, height, width])
    cores = str(os.cpu_count())
    config = {
        "INFERENCE_PRECISION_HINT": "f32",  # else bfloat16 on some processors
        "ENABLE_CPU_PINNING": False,  # else every process computes on the same core
        "INFERENCE_NUM_THREADS": cores,
        "NUM_STREAMS": cores,
    }
    return _core().compile_model(model, "CPU", config)


@cache
def _core() -> Any:
    """Return the process's one Core: when a second ends, it unmaps the stack on which signals are handled."""
    import openvino

    return openvino.Core()
