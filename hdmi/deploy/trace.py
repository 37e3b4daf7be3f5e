"""Tracing of modules into ONNX, without what the exporter has to say about it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import onnx
import torch
from torch import Tensor, nn

OPSET = 20


def trace(
    module: nn.Module, inputs: Mapping[str, Tensor], outputs: Sequence[str], open_sizes: Any = None
) -> onnx.ModelProto:
    """A module as a graph, in evaluation mode.

    Args:
        inputs: examples of its positional arguments, by the names that they get.
        outputs: names.
        open_sizes: `dynamic_shapes` of torch.onnx.export.
    """
    noisy = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in noisy]
    for logger in noisy:
        logger.setLevel(logging.ERROR)
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module.eval(), tuple(inputs.values()), input_names=list(inputs), output_names=list(outputs),
                opset_version=OPSET, dynamo=True, external_data=False, verbose=False, dynamic_shapes=open_sizes,
            )  # fmt: skip
    finally:
        for logger, level in zip(noisy, levels, strict=True):
            logger.setLevel(level)
    assert program is not None
    return program.model_proto
