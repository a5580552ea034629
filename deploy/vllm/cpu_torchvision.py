"""Lets PyPI's torchvision be imported beside a torch without CUDA.

`transformers` imports torchvision for Qwen's picture processors. PyPI's wheel is linked to CUDA; beside a
CPU build of torch its compiled part does not load, and with it two operators are missing that torchvision
describes to torch on import. They are declared here just before that happens, and never called.

`make vllm` puts this module and a line that imports it on start into the environment's site-packages.
"""

import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_OPERATORS = ("nms", "qnms")
_SIGNATURE = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


class _TorchvisionFinder(importlib.abc.MetaPathFinder):
    """Finds torchvision as usual, and has the operators declared before it is run."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "torchvision":
            return None
        sys.meta_path.remove(self)
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            sys.meta_path.insert(0, self)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                _declare_operators()
                run(module)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _declare_operators() -> None:
    import torch

    if torch.version.cuda is not None:
        return
    for name in _OPERATORS:
        if not hasattr(torch.ops.torchvision, name):
            torch.library.define(f"torchvision::{name}", _SIGNATURE)


sys.meta_path.insert(0, _TorchvisionFinder())
