"""A policy's rollout as a reference motion: the "perfect reference" of section V-A.

The policy plays the whole motion in the nominal world. Poses are the simulator's, contacts are where and when forces
were measured, and what it takes to train on the result is the task that the policy was trained on.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from omegaconf import DictConfig, OmegaConf, open_dict
from scipy.ndimage import gaussian_filter1d

from hdmi.assembly import Task, make_task
from hdmi.assets import Scene
from hdmi.config import CONF, ConfigError
from hdmi.evaluation.protocol import Policy
from hdmi.evaluation.video import Moment, play_moments
from hdmi.motion import Motion, Playback, find_motion, load_motion
from hdmi.motion.format import motion_from_poses
from hdmi.motion.kinematics import nearest_frames
from hdmi.workshop.annotate import intervals, without_chatter
from hdmi.workshop.annotate.contacts import effector_points

MIN_FORCE = 1.0  # N; of a contact, where the task's lost_contact does not say
PAUSE = 0.1  # s; shorter contacts and interruptions are chatter, half of what a policy needs to let go and grasp again
SPREAD = 0.1  # s; standard deviation over which contact points are averaged
POINTS = ("touch", "effector")  # what contact points can be
_SLIDER, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


def nominal_config(cfg: DictConfig) -> DictConfig:
    """A training config with the robot and object as they are described, and nothing drawn at random.

    Without randomization, action delay and smoothing, observation noise (all as in `ablation=no_randomization`) and
    reset noise. The object's joint gets the middle of the friction and damping that the training drew: the object's
    description has hardly any, and a seat that falls open by itself is not what the policy has learned to open.
    """
    cfg = copy.deepcopy(cfg)
    joint = (cfg.get("randomization") or {}).get("object_joint")
    with open_dict(cfg):
        cfg.merge_with(OmegaConf.load(CONF / "ablation" / "no_randomization.yaml"))
        if joint is not None:
            middle = {key: [sum(joint[key]) / 2] * 2 for key in ("friction", "damping")}
            cfg.randomization = {"object_joint": {**joint, **middle}}
        if state := (cfg.get("reset") or {}).get("state"):
            state.noise = {}
    return cfg


@dataclass(frozen=True)
class Rollout:
    """What one world did over a motion: T frames, the first one the start.

    Examples:
        >>> still = np.zeros((2, 7))
        >>> poses = {"body_pos": np.zeros((2, 1, 3)), "body_quat": np.zeros((2, 1, 4))}
        >>> contacts = {"force": np.zeros((2, 1)), "pressure": np.zeros((2, 1)), "touch": np.zeros((2, 1, 3))}
        >>> rollout = Rollout(qpos=still, sent=np.array([[0.0], [0.1]]), **poses, **contacts)
        >>> rollout.joint_target.tolist()  # sent on the way from frame 0 to 1
        [[0.1], [0.1]]
    """

    qpos: np.ndarray  # [T, nq]
    sent: np.ndarray  # [T, J] rad, where servos were sent in the step that led to each frame
    body_pos: np.ndarray  # [T, nbody, 3] m, world frame
    body_quat: np.ndarray  # [T, nbody, 4] wxyz
    force: np.ndarray  # [T, E] N, the sum of what the object exerts on each effector
    pressure: np.ndarray  # [T, E] N, over all contacts between the two
    touch: np.ndarray  # [T, E, 3] m, their mean weighted by force, in the frame of the object's link

    @property
    def joint_target(self) -> np.ndarray:
        """Where servos are sent from each frame on, as the format has it; from the last one where they were. [T, J]"""
        return np.concatenate([self.sent[1:], self.sent[-1:]])


def record_motion(
    policy: Policy,
    cfg: DictConfig,
    name: str = "recording",
    seed: int = 0,
    targets: bool = False,
    points: str = "touch",
) -> Motion:
    """Plays a policy over its whole motion, without noise in the nominal world, and makes a reference of it.

    It has the frames of the motion that was tracked, at the control rate, and its names of bodies and joints; joints
    of the robot that the motion lacks follow, and bodies and joints that the scene does not have are left out.

    Args:
        policy: `policy` -> `action`; its mean actions count.
        cfg: of its training.
        name: of the motion.
        seed: of whatever else is drawn; the caller's random state is left alone.
        targets: also where servos were sent, as `joint_target`.
        points: contact points are where the object was felt (`touch`), or where the effectors were meanwhile, their own
            points (`effector`), which is what rewards and terminations compare with them.

    Raises:
        ConfigError: if the policy does not reach the motion's end; names what ended the episode, and the frame.
        ConfigError, MotionError: for an argument, a config or a motion that cannot be used.
    """
    if points not in POINTS:
        raise ConfigError(f"points: expected one of {', '.join(POINTS)}, got {points!r}")
    cfg = nominal_config(cfg)
    task = make_task(cfg)
    source = load_motion(find_motion(cfg.task.motion, cfg.motion_root))
    rollout = roll_out(policy, cfg, task, seed)
    return rollout_motion(rollout, task, source, name, min_contact_force(cfg), targets, points)


def min_contact_force(cfg: DictConfig) -> float:
    """Force from which on a touch is a contact, N: that below which the task's `lost_contact` takes one for lost.

    A rollout that is tracked perfectly then loses none of the contacts that it is labelled with. The 10 N of the
    interaction reward are what it likes to see: softer touches move objects, too.
    """
    node = (cfg.get("termination") or {}).get("lost_contact") or {}
    return float(node.get("min_force", MIN_FORCE))


def roll_out(policy: Policy, cfg: DictConfig, task: Task, seed: int = 0) -> Rollout:
    """Plays a policy from the first frame to the last.

    Raises:
        ConfigError: if a termination or a divergence ends the episode before; names it, and the frame.
    """
    rows, failed = [], None
    for moment in play_moments(cfg, task, policy, seed=seed):
        if moment.failure is not None:
            failed = moment
            break  # and with it the environment, before the error leaves
        data = moment.data
        force = np.linalg.norm(data.sensordata[task.scene.effector_sensors], axis=-1)
        state = (value.copy() for value in (data.qpos, data.ctrl, data.xpos, data.xquat))  # the world goes on
        rows.append((*state, force, *touches(moment, task.scene)))
    if failed is not None:
        raise ConfigError(
            f"the policy fails by {failed.failure} at frame {failed.frame} of {task.reference.num_frames - 1}: a "
            "reference needs a rollout over the whole motion"
        )
    return Rollout(*(np.stack(column) for column in zip(*rows, strict=True)))


def touches(moment: Moment, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """How hard each effector is pressed against the object, N [E], and where, in the frame of its link, m [E, 3].

    The place is the mean of all contacts between the two, weighted by their forces; zero where there are none.
    """
    model, data = moment.model, moment.data
    bodies = np.array([model.body(effector.body).id for effector in scene.effectors], int)
    pressure, place, wrench = np.zeros(len(bodies)), np.zeros((len(bodies), 3)), np.zeros(6)
    for i, contact in enumerate(data.contact):
        for own, other in (contact.geom, contact.geom[::-1]):
            touching = (bodies == model.geom_bodyid[own]) & (other in scene.object_geoms)
            if touching.any():
                mujoco.mj_contactForce(model, data, i, wrench)
                strength = np.linalg.norm(wrench[:3])
                pressure[touching] += strength
                place[touching] += strength * contact.pos
    if (pressed := pressure > 0).any():
        link_pos, link_mat = data.xpos[scene.object_link], data.xmat[scene.object_link].reshape(3, 3)
        place[pressed] = (place[pressed] / pressure[pressed, None] - link_pos) @ link_mat
    return pressure, place


def rollout_motion(
    rollout: Rollout,
    task: Task,
    source: Motion,
    name: str = "recording",
    min_force: float = MIN_FORCE,
    targets: bool = False,
    points: str = "touch",
) -> Motion:
    """The motion of a rollout, under the names of the motion that it tracked; see `record_motion`.

    Args:
        rollout, task, source: what the world did, where, and the motion that was tracked.
        min_force: from which on a touch is a contact, N.
        name, targets, points: as of `record_motion`.
    """
    scene, fps = task.scene, 1 / task.scene.sim.control_dt
    model = scene.model
    bodies = {model.body(i).name: i for i in range(1, model.nbody)}
    angles = {model.joint(j).name: j for j in range(model.njnt) if model.jnt_type[j] in (_SLIDER, _HINGE)}
    body_names = [body for body in source.body_names if body in bodies]
    joint_names = [joint for joint in source.joint_names if joint in angles]
    joint_names += [joint for joint in scene.robot.joint_names if joint not in joint_names]
    rows = [bodies[body] for body in body_names]
    joint_pos = rollout.qpos[:, model.jnt_qposadr[[angles[joint] for joint in joint_names]]]
    label = point = None
    if scene.effectors:
        label = contact_labels(rollout.force, min_force, round(PAUSE * fps))
        aims = np.array([effector.target for effector in scene.effectors], float)
        place = rollout.touch
        if points == "effector":
            place = effector_points(Playback(task.reference, scene, rollout.qpos, fps))
        point = touched_points(place, rollout.pressure, label, aims, SPREAD * fps)
    motion = motion_from_poses(
        name,
        fps,
        body_names,
        joint_names,
        rollout.body_pos[:, rows],
        continuous(rollout.body_quat[:, rows]),
        joint_pos,
        label,
        point,
    )
    if not targets:
        return motion
    target = joint_pos.copy()  # of joints that no servo drives
    for i, joint in enumerate(joint_names):
        if joint in scene.robot.joint_names:
            target[:, i] = rollout.joint_target[:, scene.robot.joint_names.index(joint)]
    return replace(motion, joint_target=target.astype(np.float32))


def contact_labels(force: np.ndarray, min_force: float, pause: int) -> np.ndarray:
    """Contact from forces of at least `min_force`, N, without chatter of up to `pause` frames. [T, E] -> bool [T, E]"""
    return np.stack([without_chatter(column, pause) for column in (force >= min_force).T], axis=1)


def touched_points(
    point: np.ndarray, pressure: np.ndarray, label: np.ndarray, aims: np.ndarray, spread: float
) -> np.ndarray:
    """Contact points from where effectors were pressed: averaged within each contact, held between contacts.

    Args:
        point: m. [T, E, 3]
        pressure: N, by which points are weighted, hence zero where there are none. [T, E]
        label: contact. bool [T, E]
        aims: of effectors without any contact, m. [E, 3]
        spread: standard deviation of the averaging, frames.

    Returns:
        m; out of contact those of the nearest frame in contact. [T, E, 3]
    """
    out = np.tile(aims, (len(point), 1, 1))
    for e in range(label.shape[1]):
        mean = np.full((len(point), 3), np.nan)
        for first, last in intervals(label[:, e]):
            weight = pressure[first : last + 1, e, None]
            total = gaussian_filter1d(weight, spread, axis=0, mode="constant")
            moment = gaussian_filter1d(weight * point[first : last + 1, e], spread, axis=0, mode="constant")
            np.divide(moment, total, out=mean[first : last + 1], where=total > 0)
        touched = np.flatnonzero(np.isfinite(mean[:, 0]))
        if touched.size:
            out[:, e] = mean[touched[nearest_frames(touched, np.arange(len(point)))]]
    return out


def continuous(quat: np.ndarray) -> np.ndarray:
    """The same orientations, of q and -q the one that is nearer to the frame before. [T, ..., 4]"""
    flips = (quat[1:] * quat[:-1]).sum(-1, keepdims=True) < 0
    sign = np.cumprod(np.where(flips, -1.0, 1.0), axis=0)
    return np.concatenate([quat[:1], sign * quat[1:]])
