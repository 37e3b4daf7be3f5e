"""A robot of two joints beside a box, its motion, and networks in the layouts of others, written for the tests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from onnx import TensorProto, helper, numpy_helper

SCENE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="pelvis" pos="0 0 0.8">
      <freejoint/>
      <geom type="box" size="0.05 0.05 0.05" mass="5"/>
      <body name="thigh" pos="0 0 -0.1">
        <joint name="hip" axis="0 1 0" range="-2 2" damping="1" armature="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
        <body name="shin" pos="0 0 -0.3">
          <joint name="knee" axis="0 1 0" range="-0.5 2" damping="1" armature="0.1"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
        </body>
      </body>
    </body>
    <body name="box" pos="3 0 0.5"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="50" forcerange="-60 60"/>
    <position name="knee" joint="knee" kp="50" forcerange="-40 40"/>
  </actuator>
  <sensor><contact name="object_penetration" body1="box" data="dist" reduce="mindist"/></sensor>
</mujoco>
"""
FRAMES = 20
JOINTS = ["hip", "knee"]


def motion_arrays() -> dict[str, np.ndarray]:
    """The root moves along x at 0.5 m/s, joints turn at 0.05 and 0.1 rad/s; a box goes ahead; contact from frame 5."""
    t = np.arange(FRAMES)[:, None]
    body_pos = np.stack([[[0.01 * k, 0.0, 0.8], [0.01 * k + 3.0, 0.0, 0.5]] for k in range(FRAMES)])
    return {
        "joint_pos": np.concatenate([0.001 * t, 0.002 * t], axis=1),
        "body_pos_w": body_pos,
        "body_quat_w": np.tile([1.0, 0.0, 0.0, 0.0], (FRAMES, 2, 1)),
        "object_contact": t >= 5,
        "contact_points": np.tile([0.0, 0.1, 0.0], (FRAMES, 1, 1)),
    }


def write_files(folder: Path, **changes: Any) -> Path:
    """scene.xml and motion/ in a folder; changes are of meta.json or of arrays."""
    (folder / "motion").mkdir(parents=True, exist_ok=True)
    (folder / "scene.xml").write_text(SCENE, encoding="utf-8")
    meta = {"joint_names": JOINTS, "body_names": ["pelvis", "box"], "fps": 50.0}
    arrays = motion_arrays()
    meta |= {key: value for key, value in changes.items() if key in meta}
    arrays |= {key: value for key, value in changes.items() if key in arrays}
    (folder / "motion" / "meta.json").write_text(json.dumps(meta), encoding="utf-8")
    np.savez(folder / "motion" / "motion.npz", **arrays)
    return folder


def spec_values(inputs: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    """A description of a network of the toy's two joints."""
    values: dict[str, Any] = {
        "network": "network.onnx", "joints": JOINTS, "stiffness": 50.0, "damping": {".*": 1.0},
        "default_pose": {"knee": 0.5}, "object": "box", "contact_bodies": ["hand"], "inputs": dict(inputs),
        "action": {"base": "default", "scale": [0.5, 0.25]},
    }  # fmt: skip
    return values | changes


def write_yaml(path: Path, values: Mapping[str, Any]) -> Path:
    """Plain values as YAML."""
    path.write_text(yaml.safe_dump(dict(values), sort_keys=False), encoding="utf-8")
    return path


def save_network(
    path: Path,
    nodes: Sequence[Any],
    inputs: Mapping[str, tuple[Sequence[Any], int]],
    outputs: Mapping[str, Sequence[Any]],
    constants: Mapping[str, np.ndarray],
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """An ONNX file; inputs are shapes and element types, outputs shapes."""
    graph = helper.make_graph(
        list(nodes),
        "network",
        [helper.make_tensor_value_info(name, kind, shape) for name, (shape, kind) in inputs.items()],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    path.write_bytes(model.SerializeToString())
    return path


def linear(
    path: Path,
    weight: np.ndarray,
    moments: tuple[np.ndarray, np.ndarray] | None = None,
    written: str = "sub_div",
    worlds: int | str = 1,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """`actions` = weight applied to `obs`, which may be normalized before, by subtraction or by a product.

    Args:
        weight: [D, A].
        moments: mean and deviation. [D], [D]
        written: `sub_div`, with an epsilon that is added in the graph, or `mul_add`.
    """
    constants = {"weight": weight.astype(np.float32)}
    nodes, last = [], "obs"
    if moments is not None and written == "sub_div":
        constants |= {"mean": moments[0], "std": moments[1] - 0.01, "eps": np.array(0.01)}
        nodes = [
            helper.make_node("Add", ["std", "eps"], ["divisor"]),
            helper.make_node("Sub", ["obs", "mean"], ["centred"]),
            helper.make_node("Div", ["centred", "divisor"], ["normal"]),
        ]
        last = "normal"
    elif moments is not None:
        constants |= {"factor": 1.0 / moments[1], "summand": -moments[0] / moments[1]}
        nodes = [
            helper.make_node("Mul", ["factor", "obs"], ["scaled"]),
            helper.make_node("Add", ["scaled", "summand"], ["normal"]),
        ]
        last = "normal"
    nodes.append(helper.make_node("MatMul", [last, "weight"], ["actions"]))
    constants = {name: np.asarray(value, dtype=np.float32) for name, value in constants.items()}
    shape = {"obs": ([worlds, len(weight)], TensorProto.FLOAT)}
    return save_network(path, nodes, shape, {"actions": [worlds, weight.shape[1]]}, constants, metadata)
