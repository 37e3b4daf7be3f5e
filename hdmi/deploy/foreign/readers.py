"""What others say of their networks, in the words of `hdmi.deploy.foreign.schema`: metadata in ONNX, yaml and json.

Nothing is guessed: what has no equivalent is refused by its name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hdmi.deploy.description import PolicyError
from hdmi.deploy.foreign.schema import NETWORK, one_of, read_yaml
from hdmi.deploy.foreign.stack import Graph

Values = dict[str, Any]
_NEEDED = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale", "observation_names")


def read_foreign(path: str | Path) -> Values:
    """A description, but for `motion` where the network gives none, `scene` and `object`.

    Args:
        path: of an ONNX file with metadata of mjlab or BeyondMimic, or of the yaml of HDMI's authors, beside which
            are the ONNX file and, if there is one, the json of the same name.

    Raises:
        PolicyError: if it is neither, or says what has no equivalent here; names it.
    """
    path = Path(path)
    return _authors(path) if path.suffix in (".yaml", ".yml") else _metadata(Graph(path))


# -- metadata of ONNX files: mjlab, BeyondMimic ---------------------------------------------------------------


def _anchored(term: str, more: Values) -> Callable[[Values], Values]:
    return lambda about: {
        "term": term, "bodies": [about["anchor"]], "frame": {"body": about["anchor"]}, **more
    }  # fmt: skip


def _of_bodies(term: str, more: Values) -> Callable[[Values], Values]:
    return lambda about: {"term": term, "bodies": about["bodies"], "frame": {"body": about["anchor"]}, **more}


def _plain(term: str, **more: Any) -> Callable[[Values], Values]:
    return lambda about: {"term": term, **more}


_ISAAC = {"rotation": "interleaved"}
# Observation terms of mjlab's and BeyondMimic's tracking; `about` has the names of anchor and bodies.
_MANAGED: dict[str, Callable[[Values], Values]] = {
    "command": _plain("ref_joint_state"),
    "motion_anchor_pos_b": _anchored("ref_body_pos", {}),
    "motion_anchor_ori_b": _anchored("ref_body_ori", _ISAAC),
    "motion_ref_pos_b": _anchored("ref_body_pos", {}),
    "motion_ref_ori_b": _anchored("ref_body_ori", _ISAAC),
    "body_pos": _of_bodies("body_pos", {}),
    "body_ori": _of_bodies("body_ori", _ISAAC),
    "base_lin_vel": _plain("root_lin_vel"),
    "base_ang_vel": _plain("root_ang_vel"),
    "projected_gravity": _plain("gravity"),
    "joint_pos": _plain("joint_pos_rel"),
    "joint_vel": _plain("joint_vel"),
    "actions": _plain("last_action", fill="zero"),
}


def _metadata(graph: Graph) -> Values:
    where, data = str(graph.path), graph.metadata
    if missing := [key for key in _NEEDED if key not in data]:
        raise PolicyError(
            f"{where}: its metadata lack {', '.join(missing)}; without them write the YAML by hand, see docs/foreign.md"
        )

    def numbers(key: str) -> list[float]:
        try:
            return [float(item) for item in data[key].split(",")]
        except ValueError as error:
            raise PolicyError(f"{where}: metadata {key!r}: expected numbers with commas between: {error}") from error

    joints, names = data["joint_names"].split(","), data["observation_names"].split(",")
    for key in _NEEDED[1:5]:
        if len(numbers(key)) not in ((1, len(joints)) if key == "action_scale" else (len(joints),)):
            raise PolicyError(f"{where}: metadata {key!r}: {len(numbers(key))} numbers for {len(joints)} joints")
    if "command" in names and data.get("command_names", "motion") != "motion":
        raise PolicyError(f"{where}: metadata 'command_names': {data['command_names']}: expected a motion to follow")
    about = {"anchor": data.get("anchor_body_name", ""), "bodies": data.get("body_names", "").split(",")}
    scale = numbers("action_scale")
    found: Values = {
        "network": str(graph.path),
        "joints": joints,
        "stiffness": numbers("joint_stiffness"),
        "damping": numbers("joint_damping"),
        "default_pose": numbers("default_joint_pos"),
        "action": {"base": "default", "scale": scale[0] if len(scale) == 1 else scale},
    }
    if "actions" in graph.outputs:
        found["action"]["output"] = "actions"
    others = [name for name in graph.inputs if name != "time_step"]
    if len(others) != 1:
        raise PolicyError(f"{where}: expected one input of observations, and time_step if any, got {', '.join(others)}")
    found["inputs"] = {others[0]: [_managed(name, i, names, data, about, where) for i, name in enumerate(names)]}
    if "time_step" in graph.inputs:
        found["inputs"]["time_step"] = [{"term": "step"}]
        found |= {"motion": NETWORK, "motion_bodies": about["bodies"]}
    return found


def _managed(name: str, i: int, names: Sequence[str], data: Mapping[str, str], about: Values, where: str) -> Values:
    """The i-th term, with scale, clip and history of the metadata."""
    one_of(name, list(_MANAGED), f"{where}: metadata 'observation_names'")
    term = _MANAGED[name](about)
    if "" in (term.get("frame", {}).get("body"), *term.get("bodies", ())):
        raise PolicyError(f"{where}: metadata lack 'anchor_body_name' or 'body_names', which {name} needs")

    def entry(key: str, default: str) -> str:
        items = data[f"observation_terms_{key}"].split(",") if f"observation_terms_{key}" in data else []
        if items and len(items) != len(names):
            raise PolicyError(
                f"{where}: metadata 'observation_terms_{key}': {len(items)} entries for {len(names)} terms"
            )
        return items[i] if items else default

    past, flat = float(entry("history_length", "0")), entry("flatten_history_dim", "1")
    if past > 1:
        if flat.lower() not in ("1", "1.0", "1.000", "true"):
            raise PolicyError(f"{where}: {name}: its history is not flattened, which no term here does")
        term |= {"lags": list(range(int(past) - 1, -1, -1))}  # oldest first
    scales = [float(item) for item in entry("scale", "1").split(";")]
    if scales != [1.0]:
        term["scale"] = scales[0] if len(scales) == 1 else scales
    low, _, high = entry("clip", "-inf;inf").strip("()[] ").partition(";")
    if float(high or "inf") != float("inf"):
        if float(low) != -float(high):
            raise PolicyError(f"{where}: {name}: clipped to {low} to {high}, and here only to the same on both sides")
        term["clip"] = float(high)
    return term


# -- yaml and json of HDMI's authors --------------------------------------------------------------------------


def _lags(options: Values) -> Values:
    past = options.get("history_steps", list(range(int(options.get("steps", 1)))))
    return {} if list(past) == [0] else {"lags": list(past)}


def _future(options: Values) -> Values:
    return {"steps": list(options["future_steps"])} if "future_steps" in options else {}


def _bodies(options: Values) -> Values:
    return {"bodies": list(options["body_names"])} if "body_names" in options else {}


def _joints(options: Values) -> Values:
    return {"joints": list(options["joint_names"])} if isinstance(options.get("joint_names"), list) else {}


def _reference_root(options: Values, ground: bool) -> Values:
    body = {"body": options["root_body_name"]} if "root_body_name" in options else {}
    return {"frame": {"of": "reference", "turn": "heading", **body, **({"ground": True} if ground else {})}}


def _contact_points(options: Values) -> Values:
    offsets = options.get("contact_target_pos_offset")
    term: Values = {"term": "contact_points"}
    if offsets:
        term = {"term": "object_points", "points": [[float(x) for x in point] for point in offsets]}
    return term | ({"frame": {"turn": "heading"}} if options.get("yaw_only") else {})


_HEADING: Values = {"frame": {"turn": "heading"}}
# Observation classes of the authors' training and deployment, from their options.
_AUTHORS: dict[str, Callable[[Values], Values]] = {
    "root_ang_vel_b": lambda o: {"term": "root_ang_vel"},
    "root_angvel_b": lambda o: {"term": "root_ang_vel"},
    "root_ang_vel_history": lambda o: {"term": "root_ang_vel", **_lags(o)},
    "projected_gravity_b": lambda o: {"term": "gravity"},
    "projected_gravity_history": lambda o: {"term": "gravity", **_lags(o)},
    "joint_pos_history": lambda o: {"term": "joint_pos", **_joints(o), **_lags(o)},
    "joint_pos_multistep": lambda o: {"term": "joint_pos", **_lags(o)},
    "joint_vel_history": lambda o: {"term": "joint_vel", **_joints(o), **_lags(o)},
    "joint_vel_multistep": lambda o: {"term": "joint_vel", **_lags(o)},
    "prev_actions": lambda o: {
        "term": "last_action", "fill": "zero", "layout": "time" if o.get("permute") else "joint", **_lags(o),
    },
    "ref_motion_phase": lambda o: {
        "term": "phase", **({"period": o["motion_duration_second"]} if "motion_duration_second" in o else {}),
    },
    "ref_joint_pos_future": lambda o: {"term": "ref_joint_pos", **_future(o), **_joints(o)},
    "ref_joint_vel_future": lambda o: {"term": "ref_joint_vel", **_future(o), **_joints(o)},
    "ref_body_pos_future_local": lambda o: {
        "term": "ref_body_pos", **_future(o), **_bodies(o), **_reference_root(o, ground=True),
    },
    "ref_body_ori_future_local": lambda o: {
        "term": "ref_body_ori", "rotation": "rows", **_future(o), **_bodies(o), **_reference_root(o, ground=False),
    },
    "ref_root_pos_future_b": lambda o: {"term": "ref_body_pos", **_future(o)},
    "ref_root_ori_future_b": lambda o: {"term": "ref_body_ori", "rotation": "rows", **_future(o)},
    "ref_contact_pos_b": _contact_points,
    "ref_object_contact_future": lambda o: {"term": "contact", **_future(o)},
    "object_xy_b": lambda o: {"term": "object_pos", "axes": [0, 1], **_HEADING},
    "object_heading_b": lambda o: {"term": "object_ori", "rotation": "heading", **_HEADING},
    "object_pos_b": lambda o: {"term": "object_pos"},
    "object_ori_b": lambda o: {"term": "object_ori", "rotation": "matrix"},
    "object_joint_pos": lambda o: {"term": "object_joint_pos"},
}  # fmt: skip
# Of its options, those that change nothing here: what the training adds, and where the deployment looks.
_IGNORED = {
    "noise_std", "episodic_noise_std", "object_name", "motion_path", "body_names", "joint_names", "root_body_name",
    "future_steps", "motion_duration_second",
}  # fmt: skip
_USED = {"history_steps", "steps", "permute", "flatten", "contact_target_pos_offset", "yaw_only"}


def _authors(path: Path) -> Values:
    node, graph = read_yaml(path), Graph(path.with_suffix(".onnx"))
    needed = ("observation", "action_scale", "isaac_joint_names", "joint_kp", "joint_kd", "default_joint_pos")
    if not isinstance(node, Mapping) or (missing := [key for key in needed if key not in node]):
        lacks = ", ".join(needed if not isinstance(node, Mapping) else missing)
        raise PolicyError(f"{path}: lacks {lacks}; expected the yaml of a policy of HDMI's authors")
    joints = [str(name) for name in node["isaac_joint_names"]]
    driven = [str(name) for name in node.get("policy_joint_names", joints)]
    ins, outs = _keys(path.with_suffix(".json"), graph)
    groups = {name: terms for name, terms in node["observation"].items() if not str(name).startswith("_")}
    inputs: Values = {}
    for group, terms in groups.items():
        one_of(str(group), list(ins), f"{path}: observation")
        inputs[ins[str(group)]] = [_authors_term(str(name), o, f"{path}: {name}") for name, o in terms.items()]
    if "is_init" in ins:  # only its first tick's is 1, and only in training
        inputs[ins["is_init"]] = [{"term": "constant", "value": [0.0]}]
    states = {ins[key]: outs[f"next.{key}"] for key in ins if f"next.{key}" in outs}
    scale = node["action_scale"]
    action: Values = {
        "base": "reference" if node.get("use_residual_action") else "default",
        "scale": _patterns(scale, driven, f"{path}: action_scale") if isinstance(scale, Mapping) else float(scale),
        "joints": driven,
        "clip": 100.0,
    }
    if "action" in outs:
        action["output"] = outs["action"]
    return {
        "network": str(graph.path),
        "joints": joints,
        "stiffness": _patterns(node["joint_kp"], joints, f"{path}: joint_kp"),
        "damping": _patterns(node["joint_kd"], joints, f"{path}: joint_kd"),
        "default_pose": _patterns(node["default_joint_pos"], joints, f"{path}: default_joint_pos"),
        "inputs": inputs,
        "action": action,
        **({"states": states} if states else {}),
    }


def _authors_term(name: str, options: Any, where: str) -> Values:
    one_of(name, list(_AUTHORS), where.rpartition(":")[0])
    options = dict(options or {})
    if unknown := [key for key in options if key not in _IGNORED | _USED]:
        raise PolicyError(f"{where}: {', '.join(unknown)}: has no equivalent here")
    return _AUTHORS[name](options)


def _keys(path: Path, graph: Graph) -> tuple[dict[str, str], dict[str, str]]:
    """The network's inputs and outputs by the authors' keys, which are in their order; nested keys with dots."""
    if not path.is_file():
        return {name: name for name in graph.inputs}, {name: name for name in graph.outputs}
    try:
        node = json.loads(path.read_text(encoding="utf-8"))
        keys = [[k if isinstance(k, str) else ".".join(k) for k in node[part]] for part in ("in_keys", "out_keys")]
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"{path}: needs lists in_keys and out_keys: {error!r}") from error
    for names, there, part in zip(keys, (graph.inputs, graph.outputs), ("in_keys", "out_keys"), strict=True):
        if len(names) != len(there):
            raise PolicyError(f"{path}: {part} has {len(names)} names, and {graph.path.name} has {', '.join(there)}")
    return dict(zip(keys[0], graph.inputs, strict=True)), dict(zip(keys[1], graph.outputs, strict=True))


def _patterns(node: Any, names: Sequence[str], where: str) -> dict[str, float]:
    """Numbers by joint; theirs may have patterns for joints that a policy does not have."""
    if not isinstance(node, Mapping):
        raise PolicyError(f"{where}: expected numbers by pattern")
    return {n: float(value) for pattern, value in node.items() for n in names if re.fullmatch(str(pattern), n)}
