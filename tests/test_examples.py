"""The examples in docstrings: every public class and every kernel has one, and each shows what it says."""

from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from test_docs import public_names

# modules whose examples need an extra
EXTRAS = {
    "hdmi.workshop.author.solve": "mink",
    "hdmi.workshop.ik": "mink",
    "hdmi.workshop.repair.pipeline": "mink",
    "hdmi.workshop.retarget.measures": "mink",
    "hdmi.workshop.view.browser": "viser",
}

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def documented() -> dict[str, Any]:
    """Public classes by name, kernels, and whatever else has an example."""
    found = {}
    for module, names in public_names().items():
        for name in names:
            item = getattr(importlib.import_module(module), name)
            kernel = module == "hdmi.functional"
            if inspect.isclass(item) or kernel or (inspect.isfunction(item) and ">>>" in (item.__doc__ or "")):
                found[f"{module}.{name}"] = item
    return found


@pytest.mark.parametrize("name", documented())
def test_example(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in an empty folder, after the package's own example, with what it exports, np, torch and TensorDict."""
    item = documented()[name]
    if extra := EXTRAS.get(item.__module__):
        pytest.importorskip(extra)
    monkeypatch.chdir(tmp_path)
    package = importlib.import_module(name.rpartition(".")[0])
    exported = getattr(package, "__all__", None) or [key for key in vars(package) if not key.startswith("_")]
    names = {key: getattr(package, key) for key in exported} | {"np": np, "torch": torch, "TensorDict": TensorDict}
    parse = doctest.DocTestParser().get_examples
    before, own = parse(inspect.getdoc(package) or ""), parse(inspect.getdoc(item) or "")
    assert own, f"{name} has no example"
    report: list[str] = []
    example = doctest.DocTest(before + own, names, name, None, None, None)
    doctest.DocTestRunner(optionflags=OPTIONS).run(example, out=report.append)
    assert not report, "".join(report)
