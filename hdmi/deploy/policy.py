"""A policy's graph in ONNX Runtime, and the state that it carries from tick to tick. Needs no torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnxruntime

from hdmi.deploy.description import Description, PolicyError, read_description
from hdmi.deploy.format import GRAPH_FILE, TARGET

_DTYPES = {"tensor(float)": np.float32, "tensor(int64)": np.int64, "tensor(bool)": np.bool_}
_CLOCK = "state.ref.step"  # frame of the motion


class SensorError(ValueError):
    """Sensors that are missing, unknown, of a wrong shape or not finite; the message names them."""


class OutputError(ArithmeticError):
    """A graph whose result is not finite."""


class Policy:
    """From sensors to joint position targets, one call each control step.

    Runs on one thread of the CPU. The same sensors after the same `reset` give the same targets.

    Args:
        path: of an exported policy's folder, or of its graph.

    Attributes:
        description: what the file says of robot and motion.
        sensors: names of the sensors that the policy depends on.
        digest: SHA-256 of the file.
        frame: of the motion that the last call was about; `start_frame - 1` before the first.

    Raises:
        PolicyError: if there is no such file, or it is not an exported policy.
    """

    def __init__(self, path: str | Path):
        path = Path(path)
        path = path / GRAPH_FILE if path.is_dir() else path
        if not path.is_file():
            raise PolicyError(f"{path}: there is no such file; `hdmi export` of a policy writes it")
        where, content = str(path), path.read_bytes()
        self.path = path
        self.digest = hashlib.sha256(content).hexdigest()
        self._session = open_graph(content, where)
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.description: Description = read_description(metadata, where)
        inputs = {value.name: value for value in self._session.get_inputs()}
        outputs = {value.name: value for value in self._session.get_outputs()}
        if TARGET not in outputs:
            raise PolicyError(f"{where}: has no output {TARGET!r}; it has {', '.join(outputs)}")
        self._expect(outputs[TARGET].shape, (len(self.description.joint_names),), f"{where}: output {TARGET!r}")
        self.sensors = tuple(name for name in inputs if not name.startswith("state."))
        for name in self.sensors:
            if name not in self.description.sensors:
                raise PolicyError(
                    f"{where}: input {name!r} is none of its sensors {', '.join(self.description.sensors)}"
                )
            self._expect(inputs[name].shape, self.description.sensors[name], f"{where}: input {name!r}")
        self._initial = self._initial_state(metadata.get("state", "{}"), inputs, outputs, where)
        self._outputs = [TARGET, *(name.replace("state.", "next.", 1) for name in self._initial)]
        self.reset()

    @staticmethod
    def _expect(shape: list[int], expected: tuple[int, ...], where: str) -> None:
        if tuple(shape) != tuple(expected):
            raise PolicyError(f"{where}: expected shape {list(expected)}, got {list(shape)}")

    def _initial_state(self, text: str, inputs: Mapping, outputs: Mapping, where: str) -> dict[str, np.ndarray]:
        """State before the first tick, by the name of its input."""
        try:
            given = {f"state.{name}": value for name, value in json.loads(text).items()}
        except (ValueError, AttributeError) as error:
            raise PolicyError(f"{where}: metadata 'state' cannot be read: {error}") from error
        state: dict[str, np.ndarray] = {}
        for name, value in inputs.items():
            if not name.startswith("state."):
                continue
            if name not in given:
                raise PolicyError(f"{where}: metadata 'state' lacks {name.removeprefix('state.')!r}")
            if value.type not in _DTYPES:
                raise PolicyError(f"{where}: input {name!r}: expected one of {', '.join(_DTYPES)}, got {value.type}")
            after = name.replace("state.", "next.", 1)
            if after not in outputs:
                raise PolicyError(f"{where}: has no output {after!r} for its input {name!r}")
            state[name] = np.asarray(given[name], dtype=_DTYPES[value.type])
            self._expect(value.shape, state[name].shape, f"{where}: input {name!r}")
            self._expect(outputs[after].shape, state[name].shape, f"{where}: output {after!r}")
        return state

    def reset(self, start_frame: int = 0) -> None:
        """The next call is the first of an episode, at a frame of the motion.

        Raises:
            ValueError: for a frame that the motion does not have, or any but the first of a policy without clock.
        """
        if not 0 <= start_frame < self.description.num_frames:
            raise ValueError(f"start_frame: expected 0 to {self.description.num_frames - 1}, got {start_frame}")
        if start_frame and _CLOCK not in self._initial:
            raise ValueError(f"start_frame: the policy has no clock and starts at 0, got {start_frame}")
        self.state = dict(self._initial)
        if _CLOCK in self.state:
            self.state[_CLOCK] = np.full_like(self.state[_CLOCK], start_frame)
        self.frame = start_frame - 1

    @property
    def finished(self) -> bool:
        """Whether the last call was about the motion's last frame."""
        return self.frame >= self.description.num_frames - 1

    def __call__(self, sensors: Mapping[str, np.ndarray]) -> np.ndarray:
        """Joint position targets of this control step, rad. float32 [J]

        Args:
            sensors: those of `self.sensors`, by name; further known ones are ignored.

        Raises:
            SensorError: if one is missing, unknown, of a wrong shape or not finite.
            OutputError: if the result is not finite; the state stays as it was.
        """
        feed = checked_sensors(sensors, self.sensors, self.description.sensors, np.float32)
        target, *after = self._session.run(self._outputs, feed | self.state)
        if not np.isfinite(target).all():
            raise OutputError(f"{TARGET} is not finite at frame {self.frame + 1}")
        self.state = dict(zip(self._initial, after, strict=True))
        self.frame = min(self.frame + 1, self.description.num_frames - 1)
        return target


def open_graph(content: bytes, where: str) -> onnxruntime.InferenceSession:
    """A graph in ONNX Runtime, on one thread of the CPU.

    Args:
        where: the file, for messages.

    Raises:
        PolicyError: if it is none.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common class
        reason = str(error).splitlines()[0]
        raise PolicyError(f"{where}: is no ONNX graph that ONNX Runtime reads: {reason}") from error


def checked_sensors(
    sensors: Mapping[str, np.ndarray], needed: Sequence[str], shapes: Mapping[str, tuple[int, ...]], dtype: type
) -> dict[str, np.ndarray]:
    """The sensors that a policy needs, as arrays of a dtype.

    Args:
        sensors: what was measured, by name.
        shapes: of all sensors that there are.

    Raises:
        SensorError: if one is missing, unknown, of a wrong shape or not finite.
    """
    if unknown := [name for name in sensors if name not in shapes]:
        raise SensorError(f"unknown sensors {', '.join(unknown)}; there is {', '.join(shapes)}")
    if missing := [name for name in needed if name not in sensors]:
        raise SensorError(f"sensors {', '.join(missing)} are missing; the policy needs {', '.join(needed)}")
    found: dict[str, np.ndarray] = {name: np.asarray(sensors[name], dtype=dtype) for name in needed}
    for name, value in found.items():
        if value.shape != shapes[name]:
            raise SensorError(f"{name}: expected shape {list(shapes[name])}, got {list(value.shape)}")
        if not np.isfinite(value).all():
            raise SensorError(f"{name}: is not finite: {value.tolist()}")
    return found
