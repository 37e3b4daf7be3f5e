"""Whether a description is right, before a rollout: each term in the motion, beside what the network was trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table

from hdmi.deploy.foreign.policy import ForeignPolicy

FLOOR = 0.05  # least deviation that differences are measured by, in the unit of the term as the network takes it


@dataclass(frozen=True)
class TermCheck:
    """A term's figures over the motion, played kinematically, and the network's own of the same features.

    Args:
        input, term: names.
        mean, deviation: over the motion. [D]
        own_mean, own_deviation: that the network normalizes by, None where it carries none. [D]
    """

    input: str
    term: str
    mean: np.ndarray
    deviation: np.ndarray
    own_mean: np.ndarray | None = None
    own_deviation: np.ndarray | None = None

    @property
    def off(self) -> np.ndarray | None:
        """In the network's deviations: how far means are apart, or the motion's deviation if that is more. [D]

        A right term has about 1 at most: training adds noise and errors to what the motion gives.
        """
        if self.own_mean is None or self.own_deviation is None:
            return None
        return np.maximum(np.abs(self.mean - self.own_mean), self.deviation) / np.maximum(self.own_deviation, FLOOR)


def check_terms(policy: ForeignPolicy) -> list[TermCheck]:
    """Figures of each term.

    Raises:
        ImportError: without onnx, which the network's own figures are read with; names the extra.
    """
    stack, frames = policy.stack, np.arange(policy.motion.num_frames)
    rows: dict[str, list[list[np.ndarray]]] = {name: [] for name in stack.observer.terms}
    before = np.zeros((1, len(stack.driven)))
    for frame in frames:
        now = policy.in_motion(np.array([frame]))
        action, now.action = now.action, before
        before = action
        for name, parts in stack.observer(now, np.array([frame == 0])).items():
            rows[name].append([part[0] for part in parts])
    own = network_moments(stack.graph.content)
    found = []
    for name, terms in stack.observer.terms.items():
        at = 0
        for i, term in enumerate(terms):
            values = np.array([row[i] for row in rows[name]])
            part = slice(at, at := at + values.shape[1])
            moments = [None, None] if name not in own else [value[part] for value in own[name]]
            found.append(TermCheck(name, term.spec.term, values.mean(0), values.std(0), *moments))
    return found


def check_table(checks: list[TermCheck], most: float) -> Table:
    """The figures, each the range over a term's features; flags terms that are more than `most` deviations off."""
    table = Table(title="Terms in the motion, and as the network knows them", title_justify="left")
    for column in ("input", "term", "features", "mean", "network's", "deviation", "network's", "off", ""):
        table.add_column(column, justify="left" if column in ("input", "term", "") else "right")
    for check in checks:
        off = check.off
        flag = "" if off is None else f"feature {int(off.argmax())}" if off.max() > most else "ok"
        table.add_row(
            check.input, check.term, str(len(check.mean)), _range(check.mean), _range(check.own_mean),
            _range(check.deviation), _range(check.own_deviation), "" if off is None else f"{off.max():.1f}", flag,
        )  # fmt: skip
    return table


def _range(values: np.ndarray | None) -> str:
    if values is None:
        return "-"
    low, high = float(values.min()), float(values.max())
    return f"{low:.2f}" if low == high else f"{low:.2f} .. {high:.2f}"


def network_moments(content: bytes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Means and deviations by which a network normalizes its inputs, by input; absent where it does not.

    They are found as constants of (x - mean) / deviation or of x * scale + shift, at the input, however written.

    Args:
        content: of the ONNX file.

    Raises:
        ImportError: without onnx; names the extra.
    """
    try:
        import onnx
    except ImportError as error:
        raise ImportError("the network's own figures need onnx: pip install 'hdmi[deploy]'") from error
    graph = onnx.load_from_string(content).graph
    constants = _Constants(graph)
    found = {}
    for value in graph.input:
        scale, shift, name = np.array(1.0), np.array(0.0), value.name
        while (step := _affine(graph, name, constants)) is not None:
            factor, summand, name = step
            scale, shift = scale * factor, shift * factor + summand
        if np.size(scale) > 1 and (scale != 0).all():
            mean, deviation = np.broadcast_arrays(-shift / scale, 1.0 / np.abs(scale))
            found[value.name] = (mean.reshape(-1), deviation.reshape(-1))
    return found


def _affine(graph: Any, name: str, constants: Callable[[str], Any]) -> tuple[Any, Any, str] | None:
    """Factor and summand of the only node that a value goes to, and the node's result; None if it is not affine."""
    users = [node for node in graph.node if name in node.input]
    if len(users) != 1:
        return None
    node = users[0]
    if node.op_type in ("Identity", "Cast", "Flatten", "Reshape", "Squeeze", "Unsqueeze") and node.input[0] == name:
        return 1.0, 0.0, node.output[0]
    if node.op_type not in ("Sub", "Add", "Mul", "Div") or len(node.input) != 2:
        return None
    first = node.input[0] == name
    other = constants(node.input[1] if first else node.input[0])
    if other is None or (not first and node.op_type in ("Sub", "Div")):
        return None
    if node.op_type in ("Mul", "Div"):
        return other if node.op_type == "Mul" else np.reciprocal(other), 0.0, node.output[0]
    return 1.0, other if node.op_type == "Add" else -other, node.output[0]


class _Constants:
    """Values of a graph that depend on no input."""

    def __init__(self, graph: Any):
        from onnx import numpy_helper

        self.known: dict[str, np.ndarray | None] = {
            item.name: numpy_helper.to_array(item) for item in graph.initializer
        }
        self.makers = {name: node for node in graph.node for name in node.output}

    def __call__(self, name: str) -> np.ndarray | None:
        if name not in self.known and name in self.makers:
            self.known[name] = self._run(self.makers[name], name)
        value = self.known.get(name)
        return None if value is None else np.asarray(value, dtype=float)

    def _run(self, node: Any, name: str) -> np.ndarray | None:
        from onnx import TensorProto, helper
        from onnx.reference import ReferenceEvaluator

        given = {key: self(key) for key in node.input if key}
        if any(value is None for value in given.values()):
            return None
        ins = [helper.make_tensor_value_info(key, TensorProto.FLOAT, None) for key in given]
        out = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None)]
        model = helper.make_model(helper.make_graph([node], "constant", ins, out))
        return ReferenceEvaluator(model).run([name], {k: v.astype(np.float32) for k, v in given.items()})[0]  # type: ignore
