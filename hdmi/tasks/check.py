"""The tasks of conf/task: what each consists of, a smoke test, and a picture of its reference."""

from __future__ import annotations

import copy
import io
import math
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from rich.table import Table
from scipy.stats import wilcoxon
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from hdmi.assembly import Task, make_env, make_task, scene_parts
from hdmi.config import ConfigError, task_config
from hdmi.evaluation.agents import BlindAgent, blind_agent
from hdmi.evaluation.protocol import EvalResult, evaluate_policy, evaluation_config, make_evaluation_env
from hdmi.learning import make_trainer
from hdmi.motion import find_motion, load_motion, make_playback
from hdmi.threads import set_threads

_SPEC_ENVS, _EPISODES = 2, 16
_RETURN_ENVS, _RETURN_STEPS = 384, 96  # episodes before and after a training, and control steps of each
_HOLD_TIME, _HOLD_STARTS = 0.5, 8  # s; frames to start from
_HELD = 0.5  # of the contacts, which a reference that can be learned keeps without a policy
_CHANCE = 0.01  # p-value below which a training counts as an improvement


# -- what there is --------------------------------------------------------------------------------------------


# -- does it hold together ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Contact:
    """How the reference meets the object where its labels say, for one end effector.

    Args:
        effector: body of the robot.
        distance: from its point to the contact point, in each labelled frame, m. [F]
        gap: between its collision shapes and the object's, in each labelled frame, m; negative inside, at most
            `hdmi.motion.playback.FAR`. [F]

    Examples:
        >>> from hdmi.config import task_config
        >>> left, right = measure_contacts(task_config("lift_box"))
        >>> left.effector, bool(left.gap.max() < 0.01)  # m
        ('left_wrist_yaw_link', True)
    """

    effector: str
    distance: np.ndarray
    gap: np.ndarray


def measure_contacts(cfg: DictConfig) -> list[Contact]:
    """Replays the reference of a config without physics and measures every labelled contact of its effectors.

    Raises:
        ConfigError, MotionError: for a node or a motion that cannot be used.
    """
    motion = load_motion(find_motion(cfg.task.motion, cfg.motion_root))
    playback = make_playback(motion, **scene_parts(cfg))
    effectors, object_geoms = playback.scene.effectors, playback.scene.object_geoms
    if not effectors:
        return []
    label = playback.reference.contact.numpy()
    distance = np.linalg.norm(playback.effector_pos_w - playback.contact_pos_w, axis=-1)  # [T, E]
    contacts = []
    for e, effector in enumerate(effectors):
        own = playback.robot_geoms[playback.on_bodies([effector.body])]
        gap = playback.distances(own, object_geoms).min(axis=1)  # [T]
        contacts.append(Contact(effector.body, distance[label[:, e], e], gap[label[:, e]]))
    return contacts


@dataclass(frozen=True)
class Hold:
    """How an object is held without a policy, over half a second from frames all over the contact, in order of time.

    Args:
        contacts: share of the intended contacts that last, by start. [S]
        turn: how far the object is turned away from the reference's in the end, mean of the episodes, rad. [S]

    Examples:
        >>> print(Hold(contacts=np.array([0.5, 1.0]), turn=np.array([0.1, 0.3])))
        75%, 0.20 rad
    """

    contacts: np.ndarray = field(default_factory=lambda: np.zeros(0))
    turn: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __str__(self) -> str:
        return f"{self.contacts.mean():.0%}, {self.turn.mean():.2f} rad" if len(self.contacts) else ""


def measure_hold(cfg: DictConfig, task: Task) -> Hold:
    """Lets servos alone hold what the reference holds.

    Servos follow the reference, with the torques that it asks for where the config feeds them forward, under the task's
    randomization, from the reference's own states. Where what is held slips or tips out of the hands at once, no policy
    finds out how to hold it.

    Returns:
        None of both if no contact is labelled for so long.
    """
    cfg = copy.deepcopy(cfg)
    cfg.reset.state.noise = None
    label = task.reference.contact.cpu().numpy()  # [T, E]
    steps = round(_HOLD_TIME / task.scene.sim.control_dt)
    lasting = [t for t in range(len(label) - steps) if label[t].any() and (label[t : t + steps + 1] == label[t]).all()]
    contacts, turn = [], []
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(cfg.seed)
        for at in np.linspace(0, len(lasting) - 1, _HOLD_STARTS if lasting else 0).round().astype(int):
            env = make_evaluation_env(evaluation_config(cfg, start=lasting[at]), task, _EPISODES)
            env.set_seed(cfg.seed)
            agent = BlindAgent("zero", env.action_spec.shape[-1])
            metrics = env.rollout(steps, agent, break_when_any_done=False)["next", "metrics"]
            contacts.append(float(metrics["contact_made"].sum() / metrics["contact_intended"].sum()))
            turn.append(float(metrics["object_ori_error"][:, -1].mean()))
            env.close()
    return Hold(np.array(contacts), np.array(turn))


@dataclass(frozen=True)
class Training:
    """What a short training changed: returns of the untrained and of the trained policy, in the same episodes.

    Args:
        before, after: sum of rewards over the first steps of each episode. [N]

    Examples:
        >>> Training(before=np.array([1.0, 2.0, 3.0]), after=np.array([2.0, 4.0, 6.0])).gain
        (2.0, 2.0)
    """

    before: np.ndarray
    after: np.ndarray

    @property
    def gain(self) -> tuple[float, float]:
        """Mean and median difference of the returns."""
        difference = self.after - self.before
        return float(difference.mean()), float(np.median(difference))

    @property
    def chance(self) -> float:
        """One-sided p-value of Wilcoxon's signed-rank test that the trained policy is no better.

        Ranks, because returns have long tails: an episode that starts with a shin in a door may return -179.
        """
        return float(wilcoxon(self.after - self.before, zero_method="zsplit", alternative="greater").pvalue)


@dataclass
class TaskCheck:
    """What the smoke test of one task found; `problems` is empty if it passed.

    Examples:
        >>> check = TaskCheck("walk")
        >>> check.problems.append("reference: ...")
        >>> len(check.problems)
        1
    """

    name: str
    contacts: list[Contact] = field(default_factory=list)
    hold: Hold = field(default_factory=Hold)
    zero: EvalResult | None = None  # servos that follow the reference
    training: Training | None = None
    seconds: float = 0.0
    problems: list[str] = field(default_factory=list)


def check_task(
    name: str,
    motion_root: str | None = None,
    frames: int = 65_536,
    num_envs: int = 128,
    num_threads: int = 0,
    config_dir: str | None = None,
) -> TaskCheck:
    """Smoke test of a task: its environment, its reference, no policy, and a short training.

    1. The environment builds and passes TorchRL's spec check.
    2. The reference, replayed without physics, meets the object where its labels say: end effectors are on average as
       close to their contact points as the lost-contact termination asks for.
    3. Servos that follow the reference give finite survival and errors, and keep hold of an object that is free to
       fall: half of the contacts last for half a second, from starts in the middle of them.
    4. A training of `frames` control steps improves the return that PPO maximizes, that of the policy with its
       exploration noise: both policies play the first steps of the same episodes (start frames, perturbations and
       randomization drawn alike), and a signed-rank test finds the trained one better. If it does not, another
       training of twice as many gets a second chance: where the reference nearly succeeds without a policy, what so
       few frames add is a matter of luck. 0 skips it.

    Raises:
        ConfigError, MotionError: if the task or its motion does not exist or cannot be used.
    """
    start = time.perf_counter()
    cfg = task_config(name, motion_root, config_dir)
    cfg.num_envs, cfg.total_frames, cfg.num_threads, cfg.logger.wandb = num_envs, frames, num_threads, None
    if frames < 0:
        raise ConfigError(f"frames: expected 0 or more, got {frames}")
    set_threads(num_threads)
    task = make_task(cfg)
    check = TaskCheck(name)
    try:
        check_env_specs(make_env(cfg, _SPEC_ENVS, task))
    except AssertionError as error:
        check.problems.append(f"specs: {error}")
    check.contacts = measure_contacts(cfg)
    lost = (cfg.termination or {}).get("lost_contact")
    limit = math.inf if lost is None else lost.distance
    for contact in check.contacts:
        if not len(contact.distance):
            check.problems.append(f"{contact.effector}: the motion labels no contact")
        elif (mean := contact.distance.mean()) > limit:
            check.problems.append(
                f"{contact.effector}: on average {mean:.2f} m from its contact point where labels say that it touches, "
                f"and lost_contact allows {limit:g} m"
            )
    check.hold = measure_hold(cfg, task)
    kept = check.hold.contacts
    if task.scene.object_free_dof is not None and len(kept) and not kept.mean() >= _HELD:
        check.problems.append(
            f"reference: without a policy {kept.mean():.0%} of the contacts last {_HOLD_TIME:g} s from starts in "
            f"the middle of them, expected {_HELD:.0%}: see where hands touch the object, and whether it slips or tips"
        )
    check.zero = evaluate_policy(blind_agent("zero", cfg, task), cfg, _EPISODES, task)
    bad = [key for key, value in check.zero.figures().items() if not math.isfinite(value["mean"])]
    if bad or not check.zero.figures():
        check.problems.append(f"no policy: {bad or 'no figures'} not finite")
    if frames:
        check.training = _train(cfg, task)
        if not check.training.chance < _CHANCE:
            cfg.total_frames = 2 * frames
            check.training = _train(cfg, task)
        chance = check.training.chance
        if not chance < _CHANCE:
            mean, middle = check.training.gain
            check.problems.append(
                f"training of {cfg.total_frames} frames: the return changed by {mean:+.3f}, in the median by "
                f"{middle:+.3f}; signed-rank test: p = {chance:.2g}, expected less than {_CHANCE:g}"
            )
    check.seconds = time.perf_counter() - start
    return check


def _train(cfg: DictConfig, task: Task) -> Training:
    """What a training changes; it leaves nothing behind."""
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        trainer = make_trainer(cfg, Path(folder))
        before = returns(cfg, task, trainer.actor)
        trainer.run()
        return Training(before, returns(cfg, task, trainer.actor))


def returns(cfg: DictConfig, task: Task, actor: torch.nn.Module) -> np.ndarray:
    """Sum of rewards over the first steps of episodes that begin alike in each call, acting with noise. [N]"""
    with torch.random.fork_rng(), torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(cfg.seed)
        env = make_env(cfg, _RETURN_ENVS, task)
        env.set_seed(cfg.seed)
        steps = env.rollout(_RETURN_STEPS, actor, break_when_any_done=False)["next"]
        env.close()
    done = steps["done"].int()
    first = done.cumsum(1) - done == 0  # up to the end of the first episode. [N, T, 1]
    return (steps["reward"] * first).sum((1, 2)).numpy()


def check_table(checks: Sequence[TaskCheck]) -> Table:
    """The figures of several checks, a row for each task."""
    title = f"Tasks: {sum(not check.problems for check in checks)} of {len(checks)} pass"
    table = Table(title=title, title_justify="left")
    columns = ("task", "contact distance m", "surface gap m", "no policy: holds", "survives", "joints rad", "bodies m")
    for column in (*columns, "object", "return", "s", "problems"):
        table.add_column(column, overflow="fold")
    for check in checks:
        distance = " ".join(f"{c.distance.mean():.3f}" if len(c.distance) else "-" for c in check.contacts)
        gap = " ".join(f"{np.median(c.gap):.3f}" if len(c.gap) else "-" for c in check.contacts)
        figures = {} if check.zero is None else check.zero.figures()

        def shown(key: str, unit: str = "", figures: dict[str, dict[str, float]] = figures) -> str:
            return f"{figures[key]['mean']:.3f}{unit}" if key in figures else ""

        object_error = shown("object_joint_error", " rad") or shown("object_pos_error", " m")
        learned = check.training
        gain = ""
        if learned is not None:
            mean, middle = learned.gain
            gain = f"{mean:+.2f} of {learned.before.mean():.2f}, median {middle:+.2f}, p {learned.chance:.0e}"
        table.add_row(
            check.name, distance, gap, str(check.hold), shown("survival"),
            shown("joint_error"), shown("body_error"), object_error, gain, f"{check.seconds:.0f}",
            "\n".join(check.problems) or "none",
        )  # fmt: skip
    return table


# -- what it looks like ---------------------------------------------------------------------------------------
