"""The tasks of conf/task: what each consists of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from rich.table import Table

from hdmi.assembly import scene_parts
from hdmi.assets import ObjectConfig, RobotConfig
from hdmi.config import ConfigError, task_config, task_files
from hdmi.motion import MotionError, find_motion, load_motion
from hdmi.workshop.annotate import intervals


def sources(cfg: DictConfig, motion_root: str | None = None) -> dict[str, Path]:
    """Folders of a task's motion: `shipped` with the package, and under `motion_root`."""
    found = {}
    for name, root in (("shipped", None), ("motion_root", motion_root)):
        if name == "shipped" or root is not None:
            try:
                found[name] = find_motion(cfg.task.motion, root)
            except MotionError:
                continue
    return found


def list_tasks(motion_root: str | None = None, config_dir: str | None = None) -> Table:
    """All tasks: object, scenery, effectors, robot, and the motion that `motion_root` selects, as a table.

    Tasks whose scene cannot be used are named below it.
    """
    table = Table(title="Tasks: hdmi train task=NAME", title_justify="left")
    for column in ("task", "object", "scenery", "effectors", "robot", "frames", "contact", "sources"):
        table.add_column(column, justify="right" if column == "frames" else "left")
    unusable: list[str] = []
    for name in task_files(config_dir):
        try:
            cfg = task_config(name, motion_root, config_dir)
            parts = scene_parts(cfg)
        except ConfigError as error:
            unusable.append(f"{name} cannot be used: {error}")
            continue
        found = sources(cfg, motion_root)
        path = found.get("shipped" if motion_root is None else "motion_root")
        bodies = [effector.body for effector in parts["effectors"]]
        frames, contact = _motion_columns(path, bodies)
        scenery = ", ".join(item.name for item in parts["scenery"])
        effectors = ", ".join(body.removesuffix("_link") for body in bodies)
        thing, robot = _object(parts["object"]), _robot(parts["robot"])
        table.add_row(name, thing, scenery, effectors, robot, frames, contact, ", ".join(found))
    table.caption = "\n".join(unusable) or None
    table.caption_justify = "left"
    return table


def _motion_columns(path: Path | None, bodies: Sequence[str]) -> tuple[str, str]:
    if path is None:
        return "-", "-"
    motion = load_motion(path)
    labels = motion.object_contact
    if labels is None or not bodies:
        return str(motion.num_frames), "-"
    columns = [" ".join(f"{a}-{b}" for a, b in intervals(column)) for column in labels.T]
    if len(set(columns)) > 1:
        columns = [f"{body.removesuffix('_link')} {text}" for body, text in zip(bodies, columns, strict=True)]
    return str(motion.num_frames), ", ".join(dict.fromkeys(columns))


def _object(config: ObjectConfig | None) -> str:
    if config is None:
        return "-"
    count = len(config.geoms) + (0 if config.hinge is None else len(config.hinge.geoms))
    kind = "rigid" if config.hinge is None else "articulated"
    fixed = ", fixed base" if config.fixed_base else ""
    return f"{config.name}: {kind}{fixed}, {count} geom{'s' if count > 1 else ''}, {config.mass:g} kg"


def _robot(robot: RobotConfig) -> str:
    parts = [f"{robot.feet} feet, {robot.effector} hands"]
    parts += [f"kp {value:g} {pattern}" for pattern, value in robot.stiffness.items()]
    parts += ["self-collisions"] * bool(robot.self_collisions)
    return ", ".join(parts)
