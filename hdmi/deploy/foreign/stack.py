"""What runs a network: its terms with their past, its ONNX graph, its action; for one world or many at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.deploy.description import PolicyError
from hdmi.deploy.foreign.motion import Motion
from hdmi.deploy.foreign.schema import NetworkSpec, one_of, per_joint
from hdmi.deploy.foreign.terms import TERMS, Bound, Moment, bind
from hdmi.deploy.policy import open_graph

_DTYPES = {
    "tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64, "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
}  # fmt: skip


class Graph:
    """A network in ONNX Runtime, on one thread of the CPU.

    Args:
        path: of the file.

    Attributes:
        content: the file's.
        metadata: names and texts in the file.
        inputs, outputs: shapes by name; names or None stand for what is open.

    Raises:
        PolicyError: if there is no such file, or it is no ONNX graph.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise PolicyError(f"{path}: there is no such file")
        self.content = self.path.read_bytes()
        self._session = open_graph(self.content, str(path))
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        self.inputs: dict[str, list[Any]] = {value.name: value.shape for value in self._session.get_inputs()}
        self.outputs: dict[str, list[Any]] = {value.name: value.shape for value in self._session.get_outputs()}
        self.dtypes = {value.name: _DTYPES.get(value.type, np.float32) for value in self._session.get_inputs()}

    def width(self, name: str) -> int | None:
        """Features of an input, without its batch dimension; None if the file leaves them open."""
        shape = self.inputs[name]
        sizes = shape[1:] if len(shape) > 1 else shape
        return int(np.prod(sizes)) if all(isinstance(size, int) for size in sizes) else None

    def __call__(self, given: Mapping[str, np.ndarray], outputs: Sequence[str]) -> list[np.ndarray]:
        """Outputs for features [N, D] by input: [N, *] each; one world after another where the batch is fixed to 1."""
        count = len(next(iter(given.values())))
        fixed = any(len(shape) < 2 or shape[0] == 1 for shape in self.inputs.values())
        parts = [slice(i, i + 1) for i in range(count)] if fixed else [slice(None)]
        found = [self._run({name: value[part] for name, value in given.items()}, outputs) for part in parts]
        return [np.concatenate(values) for values in zip(*found, strict=True)]

    def _run(self, given: Mapping[str, np.ndarray], outputs: Sequence[str]) -> list[np.ndarray]:
        count = len(next(iter(given.values())))
        feed: dict[str, np.ndarray] = {}
        for name, value in given.items():
            shape = self.inputs[name]
            sizes = [size if isinstance(size, int) else -1 for size in shape[1:]]
            # at most one open size follows from the others
            feed[name] = value.reshape([count, *sizes] if len(shape) > 1 else [-1]).astype(self.dtypes[name])
        return [np.asarray(value).reshape(count, -1) for value in self._session.run(list(outputs), feed)]


class Observer:
    """Inputs of a network from moments, with what lags look back on.

    Args:
        spec, motion: of the network.
        body_names: as `Kinematics.body_names`.
        where: the YAML, for messages.
    """

    def __init__(self, spec: NetworkSpec, motion: Motion, body_names: Sequence[str], where: str):
        self.where = where
        self.terms: dict[str, list[Bound]] = {
            name: [bind(term, spec, motion, body_names, f"{where}.inputs.{name}[{i}]") for i, term in enumerate(terms)]
            for name, terms in spec.inputs.items()
        }
        self.past: dict[tuple[str, int], np.ndarray] = {}

    def __call__(self, now: Moment, fresh: np.ndarray) -> dict[str, list[np.ndarray]]:
        """Features of each term of each input, [..., D_i].

        Args:
            fresh: worlds whose episode begins. bool [...]
        """
        found: dict[str, list[np.ndarray]] = {}
        for name, terms in self.terms.items():
            found[name] = [self._term((name, i), term, now, fresh) for i, term in enumerate(terms)]
        return found

    def _term(self, key: tuple[str, int], term: Bound, now: Moment, fresh: np.ndarray) -> np.ndarray:
        spec, lead = term.spec, now.step.shape
        value = TERMS[spec.term].function(now, term).reshape(*lead, -1)
        width = value.shape[-1]
        if np.size(spec.scale) not in (1, width):
            raise PolicyError(
                f"{self.where}.inputs.{key[0]}[{key[1]}].scale: {np.size(spec.scale)} numbers for the {width} features "
                f"of {spec.term}"
            )
        value = np.clip(value, -spec.clip, spec.clip) * np.asarray(spec.scale)
        depth = max(spec.lags)
        first = np.zeros_like(value) if spec.fill == "zero" else value
        begun = np.broadcast_to(first[..., None, :], (*lead, depth, value.shape[-1]))
        before = self.past.get(key, begun)
        # newest first [..., depth, D]; of another number of worlds, it is another run's
        past = np.where(fresh[..., None, None], begun, before if before.shape == begun.shape else begun)
        whole = np.concatenate([value[..., None, :], past], axis=-2)
        self.past[key] = whole[..., :depth, :]
        chosen = whole[..., list(spec.lags), :]
        return (np.swapaxes(chosen, -1, -2) if spec.layout == "joint" else chosen).reshape(*lead, -1)


class Stack:
    """From moments to joint position targets: observations, network and action, with all that they remember.

    Args:
        spec, motion, graph: what runs.
        body_names: as `Kinematics.body_names`.
        where: the YAML, for messages.

    Raises:
        PolicyError: if inputs, outputs or widths of description and network differ.
    """

    def __init__(self, spec: NetworkSpec, motion: Motion, graph: Graph, body_names: Sequence[str], where: str):
        self.spec, self.motion, self.graph, self.where = spec, motion, graph, where
        self.observer = Observer(spec, motion, body_names, where)
        names = spec.action.joints or spec.joints
        self.driven = np.array([spec.joints.index(name) for name in names])
        self.scale = per_joint(spec.action.scale, names, f"{where}.action.scale")
        self.default_pose = per_joint(spec.default_pose, spec.joints, f"{where}.default_pose")
        self._output = spec.action.output or next(iter(graph.outputs))
        self._check_names()
        self._state: dict[str, np.ndarray] = {}
        self._action = np.zeros(0)

    def _check_names(self) -> None:
        spec, graph = self.spec, self.graph
        for name in (*spec.inputs, *spec.states):
            one_of(name, list(graph.inputs), f"{self.where}.inputs: {graph.path.name}")
        for name in (self._output, *spec.states.values()):
            one_of(name, list(graph.outputs), f"{self.where}.action.output: {graph.path.name}")
        if missing := [name for name in graph.inputs if name not in spec.inputs and name not in spec.states]:
            raise PolicyError(f"{self.where}.inputs: nothing for the network's input {', '.join(missing)}")
        for name in spec.states:
            if graph.width(name) is None:
                raise PolicyError(f"{self.where}.states: the size of {name} is open in {graph.path}")
        size = graph.outputs[self._output][-1]
        if isinstance(size, int) and size != len(self.driven):
            raise PolicyError(
                f"{self.where}.action: {len(self.driven)} joints, and the network's {self._output} has {size} numbers"
            )

    def check_widths(self, now: Moment) -> None:
        """Raises PolicyError if an input's terms give another number of features than the network takes."""
        found = self.observer(now, np.ones(now.step.shape, dtype=bool))
        for name, parts in found.items():
            terms = self.observer.terms[name]
            widths = [part.shape[-1] for part in parts]
            if self.graph.width(name) not in (None, sum(widths)):
                listed = ", ".join(f"{term.spec.term} {n}" for term, n in zip(terms, widths, strict=True))
                raise PolicyError(
                    f"{self.where}.inputs.{name}: the terms give {sum(widths)} features ({listed}), "
                    f"and the network takes {self.graph.width(name)}"
                )

    @property
    def memory(self) -> tuple[Any, ...]:
        """All that the next tick depends on besides its moment."""
        return dict(self.observer.past), self._state, self._action

    @memory.setter
    def memory(self, values: tuple[Any, ...]) -> None:
        self.observer.past, self._state, self._action = values

    def last_action(self, fresh: np.ndarray) -> np.ndarray:
        """Output of the tick before, zeros in the first. [..., A]"""
        empty = np.zeros((*fresh.shape, len(self.driven)))
        return empty if self._action.shape != empty.shape else np.where(fresh[..., None], empty, self._action)

    def base(self, step: np.ndarray) -> np.ndarray:
        """What the action is added to, rad. int [...] -> [..., J]"""
        along = {"reference": self.motion.joint_pos, "joint_target": self.motion.joint_target}
        if self.spec.action.base in along:
            return along[self.spec.action.base][np.clip(step, 0, self.motion.num_frames - 1)]
        return np.broadcast_to(self.default_pose, (*step.shape, len(self.default_pose)))

    def __call__(self, now: Moment, fresh: np.ndarray) -> np.ndarray:
        """Joint position targets of this tick, rad. [..., J]

        Args:
            fresh: worlds whose episode begins. bool [...]
        """
        lead = now.step.shape
        given = {name: np.concatenate(parts, -1) for name, parts in self.observer(now, fresh).items()}
        given = {name: value.reshape(-1, value.shape[-1]) for name, value in given.items()}
        for name in self.spec.states:
            empty = np.zeros((int(np.prod(lead)), self.graph.width(name) or 0))
            given[name] = np.where(fresh.reshape(-1, 1), empty, self._state.get(name, empty))
        out, *states = self.graph(given, [self._output, *self.spec.states.values()])
        action = np.clip(out.reshape(*lead, -1), -self.spec.action.clip, self.spec.action.clip).astype(float)
        self._state = dict(zip(self.spec.states, states, strict=True))
        self._action = action
        target = np.array(self.base(now.step), dtype=float)
        target[..., self.driven] += action * self.scale
        return target
