"""The training loop: collect with the policy, estimate advantages, update by PPO, log, checkpoint."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import KLAdaptiveLR
from torchrl.objectives.value import GAE

from hdmi.assembly import Task, make_task, network_inputs
from hdmi.config import ConfigError, build, one_line, run_container
from hdmi.console import make_console
from hdmi.learning.checkpoint import (
    BEST_FILE,
    CheckpointError,
    best_checkpoint,
    claim,
    load_checkpoint,
    rotate,
    save_checkpoint,
    supersede,
)
from hdmi.learning.distributed import Ranks
from hdmi.learning.logger import RunLogger
from hdmi.learning.networks import bound_noise, network_of, normalised_actor, normalised_critic
from hdmi.learning.policy import make_networks
from hdmi.learning.resume import CONFIG_FILE, problem_changes
from hdmi.learning.warm_start import Taken, take_over
from hdmi.motion import find_motion, motion_digest
from hdmi.threads import set_threads

_WARMUP_STEPS = 8  # of the untrained policy, for first observation moments
_MAX_BAD_UPDATES = 20  # minibatches without finite loss or gradient, in a row
_FIGURES = {  # name in the log -> of the losses
    "loss_actor": "loss_objective",
    "loss_critic": "loss_critic",
    "entropy": "entropy",
    "clip_fraction": "clip_fraction",
    "imitation": "imitation",
}
_MERIT = ("eval/success_rate", "eval/survival")  # what makes the best of a run's evaluations
_COLLECTED_KEYS = ("action", "action_log_prob", ("next", "reward"), ("next", "done"), ("next", "terminated"))


Evaluate = Callable[[torch.nn.Module, DictConfig, Task], dict[str, float]]


class DivergenceError(RuntimeError):
    """Training produced no finite updates any more."""


class Trainer:
    """PPO with an asymmetric critic, on one process or on several under torchrun.

    Each iteration collects `frames_per_env` steps of `num_envs` environments, estimates advantages by GAE
    (bootstrapping through truncations), makes `epochs` passes of minibatch updates, and then updates the observation
    moments for the next collection. The actor's learning rate follows the policy's KL divergence, which is to fall
    from `desired_kl` to `final_kl` over `total_frames`, so that the policy settles. What is evaluated and leaves the
    training is the mean of the actor's weights over the last iterations (`average` of those so far), which is steadier
    than any of them. Where there are evaluations on the way (`cfg.eval_interval`), the policy that came out best is
    kept, too, in `checkpoints/best.pt`.

    Where the environment has `reward_groups`, the critic has a head for each group, trained on that group's returns,
    and the policy ascends the sum of the groups' advantages. The sum is taken before advantages are normalised, so that
    the weights of the reward table decide between groups, as they do between terms: with exact values it is the
    advantage of the summed reward, GAE being linear. What heads add is that each fits returns of one kind.

    With `algo.skip_first` the first step of an episode has a part in no loss and in no moments of advantages: its
    velocities and histories are of the reset, not of what was done. It keeps its place in the recursion of GAE, and
    in the moments of observations, since policies have to act in it.

    Args:
        cfg: the whole config; `cfg.resume` is a checkpoint to continue from, or null.
        folder: of the run; checkpoints, metrics.csv and config.yaml are written there.
        evaluate: what gives figures of a policy every `cfg.eval_interval` iterations, from the policy, the config and
            the task; without it there are none during training.

    Attributes:
        policy: from deployable observations.
        actor: that acts in training: the policy.
        averaged: `averaged.module` is the policy that leaves the training.
        inputs: terms of each network's observation and their widths.
        taken: what a warm start took over.
        groups: of rewards that the critic values each by itself, in the order of its heads; none for one head.

    Raises:
        CheckpointError: for a checkpoint that cannot be continued under this config; see `restore`.
        ConfigError, MotionError: for a config that cannot be built.

    Examples:
        >>> from pathlib import Path
        >>> from hdmi.config import task_config
        >>> cfg = task_config("walk")
        >>> cfg.merge_with({"num_envs": 2, "num_threads": 1, "total_frames": 16, "logger": {"wandb": None}})
        >>> cfg.algo.merge_with({"frames_per_env": 8, "minibatches": 1, "actor_hidden": [8], "critic_hidden": [8]})
        >>> trainer = Trainer(cfg, Path("run"))
        >>> trainer.run()
        1/1 reward ... steps/s
        >>> trainer.frames
        16
    """

    def __init__(self, cfg: DictConfig, folder: Path, evaluate: Evaluate | None = None):
        self.cfg, self.folder, self.evaluate = cfg, folder, evaluate
        self.ranks = Ranks.from_environment(cfg.device)
        self.device = torch.device(cfg.device)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", self.ranks.local_rank)
            torch.cuda.set_device(self.device)  # where NCCL exchanges objects
        self._changed: list[str] = []  # nodes that make another problem of a continued run
        state = None if cfg.resume is None else load_checkpoint(cfg.resume, self.device)
        if state is not None:
            self._check_resume(state)
        cfg.num_threads = self.ranks.threads(cfg.num_threads)
        set_threads(cfg.num_threads)
        seed = self.ranks.seed(cfg.seed)
        torch.manual_seed(seed)
        self.task: Task = make_task(cfg)
        self.motion_digest = motion_digest(find_motion(cfg.task.motion, cfg.motion_root))
        self.collector = build(cfg.collector, "collector", cfg=cfg, task=self.task, seed=seed)
        self.env = self.collector.env
        self.env.set_seed(seed)
        spec = self.env.full_observation_spec
        self.sizes = {
            "policy": spec["policy"].shape[-1],
            "critic": spec["critic"].shape[-1],
            "action": self.env.action_spec.shape[-1],
        }
        self.groups = sorted(spec.get("reward_groups", {}).keys())
        if self.groups:
            self.sizes["state_value"] = len(self.groups)
        self.policy, self.critic = make_networks(cfg, self.sizes, self.device)
        self.actor = self._acting()
        # moments do not change within an update: the learner normalises observations once for all epochs
        self.normalised_critic = normalised_critic(self.critic)
        algo = cfg.algo
        self.averaged = AveragedModel(self.policy, avg_fn=partial(_recent_mean, share=algo.average))
        objective = self._objective()
        self.objective = objective if self.ranks.size == 1 else _parallel(objective)
        self.gae = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=None)
        self.actor_optim = torch.optim.Adam(self.actor.parameters(), lr=algo.actor_lr, fused=True)
        self.critic_optim = torch.optim.Adam(self.critic.parameters(), lr=algo.critic_lr, fused=True)
        self.schedule = KLAdaptiveLR(
            self.actor_optim, target_kl=algo.desired_kl, factor=1.2, min_lr=algo.min_lr, max_lr=algo.max_lr
        )
        self.frames_per_batch = cfg.num_envs * algo.frames_per_env  # of this rank
        self.iteration = self.frames = 0
        self.bad_updates = self.lost_checkpoints = 0
        self.taken: list[Taken] = []  # by a warm start
        self.elapsed = 0.0  # s of collection and learning
        self.best: list[float] = []  # success and survival of the best evaluation on the way
        self._warm_up()
        self.inputs = network_inputs(self.env)
        if state is None and cfg.warm_start is not None:
            self._warm_start(cfg.warm_start)
        self.collector.start(self.actor)
        if state is not None:
            self.restore(state)

    def _warm_start(self, path: str) -> None:
        """Takes networks over from a run or an exported policy; what it has no critic for begins anew."""
        state = load_checkpoint(path, self.device)
        if "inputs" not in state:
            raise CheckpointError(
                f"warm_start: {path}: made by an older version, which did not write what networks see"
            )
        networks = {"policy": ("actor", self.policy), "critic": ("critic", self.critic)}
        if self.actor is not self.policy:
            raise CheckpointError("warm_start: algo=teacher_student trains another network first; it starts from none")
        self.taken = [
            take_over(network, state[entry], self.inputs[name], state["inputs"][name], name)
            for name, (entry, network) in networks.items()
            if entry in state
        ]
        self.averaged.module.load_state_dict(self.policy.state_dict())

    # -- one iteration ----------------------------------------------------------------------------------------

    def _warm_up(self) -> None:
        # sampled actions, as in training: means alone would leave the history of actions without variance
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            batch = self.env.rollout(_WARMUP_STEPS, self.actor, break_when_any_done=False, auto_cast_to_device=True).to(
                self.device
            )
            self._update_moments(batch)
            # The learner once, for nothing: compiled code is guarded by tables of tensordict that its first use fills.
            self.objective(self.prepare(batch))

    def _acting(self) -> TensorDictModuleBase:
        """What acts in training, and is trained: the policy."""
        return self.policy

    def _objective(self) -> torch.nn.Module:
        """What gives the loss of a minibatch, and its parts."""
        return Objective(self._loss(self.policy))

    def _loss(self, actor: ProbabilisticActor) -> ClipPPOLoss:
        algo = self.cfg.algo
        return ClipPPOLoss(
            normalised_actor(actor),
            self.normalised_critic,
            clip_epsilon=algo.clip,
            entropy_coeff=algo.entropy,
            critic_coeff=1.0,
            loss_critic_type="smooth_l1",
            normalize_advantage=False,
        )

    def _actors(self) -> list[torch.nn.Module]:
        """The networks of `actor`, whose gradients are bounded each by itself."""
        return [self.policy]

    def _networks(self) -> list[tuple[NestedKey, torch.nn.Module]]:
        """Networks that keep moments of an observation, with its key."""
        return [("policy", self.policy), ("critic", self.critic)]

    def _update_moments(self, batch: TensorDictBase) -> None:
        for key, network in self._networks():
            values = batch[key].reshape(-1, batch[key].shape[-1])
            network_of(network).norm.update(*self.ranks.moments(values), n=len(values) * self.ranks.size)

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """What the loss takes of a batch, computed once for all epochs.

        Args:
            batch: collected steps, [N, T], the steps of a world in order. Reads `policy`, `critic`, `action`,
                `action_log_prob`, and of `next` `critic`, `done`, `terminated`, and `reward` or, if there are G groups,
                `reward_groups`.

        Returns:
            Batch [N T]: `policy` and `critic` normalised, `action`, `action_log_prob`, and by GAE `state_value` and
            `value_target` [N T, G or 1] and `advantage` [N T, 1], the groups' sum.
        """
        data = batch.select(*_COLLECTED_KEYS)
        if self.groups:
            rewards = torch.cat([batch["next", "reward_groups", group] for group in self.groups], -1)
            data["next", "reward"] = rewards
            for key in ("done", "terminated"):
                data["next", key] = batch["next", key].expand_as(rewards)
        for key, network in (("policy", self.policy), ("critic", self.critic)):
            data.set(key, network_of(network).normalise(batch[key]))
        value = self.normalised_critic(data)["state_value"]  # [N, T, G or 1]
        # The next state is the next step's, but where an episode or the batch ends.
        last = batch["next", "done"].squeeze(-1).clone()
        last[:, -1] = True
        following = value.roll(-1, dims=1)
        following[last] = self.critic(batch["next"].select("critic")[last])["state_value"]
        data.set(("next", "state_value"), following)
        data = self.gae(data).exclude("next").reshape(-1)
        return data.set("advantage", data["advantage"].sum(-1, keepdim=True))

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One PPO update on a batch [N, T]; returns losses and statistics."""
        algo = self.cfg.algo
        progress = min(self.frames / self.cfg.total_frames, 1.0)
        self.schedule.target_kl = algo.desired_kl + (algo.final_kl - algo.desired_kl) * progress
        data = self.prepare(batch)
        if algo.skip_first:
            data = data[batch["step_count"].flatten() > 0]
        advantage = data["advantage"]
        mean, variance = self.ranks.moments(advantage)
        data["advantage"] = (advantage - mean) / (variance.sqrt() + 1e-6)
        size = self.ranks.least(data.shape[0]) // algo.minibatches  # ranks step together, by means of equal weight
        sums: dict[str, float] = {}
        count = 0
        for _ in range(algo.epochs if size else 0):  # all of them may be first steps
            order = torch.randperm(data.shape[0], device=data.device)
            for m in range(algo.minibatches):
                rows = order[m * size : (m + 1) * size]
                # twice as fast as indexing on a CPU
                losses = self._step(data.apply(lambda x, rows=rows: x.index_select(0, rows), batch_size=rows.shape))
                if losses is None:
                    continue
                count += 1
                for key, value in losses.items():
                    sums[key] = sums.get(key, 0.0) + value
        self._update_moments(batch)
        self.averaged.update_parameters(self.policy)
        stats = {key: value / max(count, 1) for key, value in sums.items()}
        target, value = data["value_target"], data["state_value"]
        stats["explained_variance"] = _explained_variance(target.sum(-1), value.sum(-1))
        for i, group in enumerate(self.groups):
            stats[f"explained_variance/{group}"] = _explained_variance(target[:, i], value[:, i])
        stats["actor_lr"] = self.actor_optim.param_groups[0]["lr"]
        stats["noise_std"] = float(batch["scale"].mean())
        return stats

    def _step(self, minibatch: TensorDictBase) -> dict[str, float] | None:
        """One gradient step; None, without touching the weights, if loss or gradient is not finite."""
        total, losses = self.objective(minibatch)
        self.actor_optim.zero_grad()
        self.critic_optim.zero_grad()
        total.backward()
        total, kl = self.ranks.mean(torch.stack([total.detach(), losses["kl_approx"]]))
        norm = self.cfg.algo.max_grad_norm
        norms = [torch.nn.utils.clip_grad_norm_(actor.parameters(), norm) for actor in self._actors()]
        actor_norm = torch.stack(norms).sum()
        critic_norm = torch.nn.utils.clip_grad_norm_(self.critic.parameters(), norm)
        figures = {name: losses[key] for name, key in _FIGURES.items() if key in losses}
        figures |= {"kl": kl, "grad_norm_actor": actor_norm}
        # the device is waited for once, not for each figure
        finite = torch.stack([total, actor_norm, critic_norm]).isfinite().all()
        *values, usable = torch.stack([*(v.detach() for v in figures.values()), finite.to(total.dtype)]).tolist()
        if not usable:
            self.bad_updates += 1
            if self.bad_updates >= _MAX_BAD_UPDATES:
                raise DivergenceError(
                    f"iteration {self.iteration}: {self.bad_updates} updates in a row without finite loss or gradient "
                    f"(loss {total.item()}); resume from an earlier checkpoint with a smaller algo.actor_lr or "
                    "algo.critic_lr"
                )
            return None
        self.bad_updates = 0
        self.actor_optim.step()
        self.critic_optim.step()
        bound_noise(self.actor)
        row = dict(zip(figures, values, strict=True))
        self.schedule.step(row["kl"])
        return row

    # -- the loop ---------------------------------------------------------------------------------------------

    def run(self, finish: Callable[[RunLogger], None] | None = None) -> None:
        """Trains up to `cfg.total_frames`; an interrupt ends it after the iteration, with a checkpoint to resume from.

        A second interrupt does not wait: what was collected for that iteration is then lost to the continued run. Of
        several ranks the first one logs and writes; interrupted, they leave the last periodic checkpoint.
        Checkpoints of the folder that are newer than where the run continues are set aside in `superseded`.

        Args:
            finish: what to do with the trained policy, on the first rank, while the log is still open.

        Raises:
            CheckpointError: if another process trains in the run folder.
            LoggerError: if W&B does not start.
            DivergenceError: if updates stay without finite loss.
            WorkerError: if a worker of the collector is gone; the last periodic checkpoint stays.
            KeyboardInterrupt: after saving.
        """
        with claim(self.folder) if self.ranks.is_first else nullcontext():
            logger = RunLogger(self.folder, self.cfg, self.iteration) if self.ranks.is_first else None
            try:
                self._run(logger)
                if finish is not None and logger is not None:
                    finish(logger)
            finally:
                if logger is not None:
                    logger.close()

    def _run(self, logger: RunLogger | None) -> None:
        cfg, first = self.cfg, logger is not None
        if first:
            OmegaConf.save(self._config_of_run(), self.folder / CONFIG_FILE)
            for path in supersede(self.folder / "checkpoints", self.iteration):
                print(f"set aside, the run goes on from iteration {self.iteration}: {path}")
            best = best_checkpoint(self.folder / "checkpoints")
            self.best = [] if best is None else load_checkpoint(best)["merit"]
        columns = (
            TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.fields[numbers]}"),
        )  # fmt: skip
        console = make_console()
        visible = first and console.is_terminal
        try:
            with (
                _deferred_interrupt(self.ranks.size == 1) as interrupted,
                Progress(*columns, console=console, refresh_per_second=2, disable=not visible) as progress,
            ):
                frames_per_iteration = self.frames_per_batch * self.ranks.size
                total = -(-cfg.total_frames // frames_per_iteration)
                bar = progress.add_task(self.task.name, total=total, completed=self.iteration, numbers="")
                while self.frames < cfg.total_frames:
                    start = time.perf_counter()
                    batch = self.collector.next()
                    collected = time.perf_counter()
                    figures = {**summarize(batch), **self.update(batch)}
                    figures |= {
                        "overflows": self.env.base_env.backend.overflows(),
                        "redrawn_starts": self.env.num_redrawn,
                        "deep_starts": self.env.num_deep,
                    }
                    row = self.ranks.mean_row(figures)
                    end = time.perf_counter()
                    self.elapsed += end - start
                    self.iteration += 1
                    self.frames += frames_per_iteration
                    row |= {
                        "frames": self.frames,
                        "minutes": self.elapsed / 60,
                        "collect_sps": frames_per_iteration / (collected - start),
                        "learn_sps": frames_per_iteration / (end - collected),
                        "train_sps": frames_per_iteration / (end - start),
                    }
                    if first and self.evaluate and cfg.eval_interval and self.iteration % cfg.eval_interval == 0:
                        with torch.random.fork_rng():
                            row |= self.evaluate(self.averaged.module, cfg, self.task)
                    if logger is not None:
                        logger.log(self.iteration, row)
                    progress.update(bar, completed=self.iteration, numbers=_headline(row))
                    if first and not visible and (self.iteration % 10 == 0 or self.frames >= cfg.total_frames):
                        console.print(f"{self.iteration}/{total} {_headline(row)}", highlight=False)
                    if first:
                        self._keep_best(row)
                    if self.iteration % cfg.checkpoint_interval == 0:
                        self.save()
                    if interrupted():
                        raise KeyboardInterrupt
                if self.ranks.size > 1:
                    self.save()
        finally:
            try:
                # ranks that were interrupted in different places cannot save together
                if self.frames and self.ranks.size == 1:
                    self.save()
            finally:
                self.collector.shutdown()

    def _config_of_run(self) -> DictConfig:
        """The config without what only this call of `hdmi train` is about: a continued run is the uninterrupted one."""
        cfg = self.cfg.copy()
        cfg.resume, cfg.resume_anyway = None, False
        return cfg

    # -- checkpoints ------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Writes a checkpoint to continue from; a full disk is reported and counted.

        The learner continues exactly; so does the collection as far as its collector does.
        """
        ranks = self.ranks.gather({"rng": torch.get_rng_state(), **self.collector.state_dict()})
        if not self.ranks.is_first:
            return
        folder = self.folder / "checkpoints"
        if self._write(folder / f"checkpoint_{self.iteration:06d}.pt", self._state() | {"ranks": ranks}):
            rotate(folder, self.cfg.keep_checkpoints)

    def _keep_best(self, row: Mapping[str, float]) -> None:
        """Writes the policy of a logged row if it evaluated as well as any before: by success, then by survival."""
        if not all(key in row for key in _MERIT):
            return
        merit = [row[key] for key in _MERIT]
        if merit >= self.best and self._write(
            self.folder / "checkpoints" / BEST_FILE, self._state() | {"merit": merit}
        ):
            self.best = merit

    def _state(self) -> dict[str, Any]:
        """What a checkpoint holds but for the ranks' own."""
        return {
            "config": run_container(self._config_of_run()),
            "task": self.task.name,
            "motion": self.motion_digest,
            "sizes": self.sizes,
            "inputs": self.inputs,
            "iteration": self.iteration,
            "frames": self.frames,
            "elapsed": self.elapsed,
            "actor": self.averaged.module.state_dict(),
            "training_actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "actor_optim": self.actor_optim.state_dict(),
            "critic_optim": self.critic_optim.state_dict(),
        }

    def _write(self, path: Path, state: dict[str, Any]) -> bool:
        """Writes a checkpoint; whether it could be."""
        try:
            save_checkpoint(path, state)
        except OSError as error:
            self.lost_checkpoints += 1
            print(f"checkpoint not written, the previous one stays: {error}", file=sys.stderr)
            return False
        return True

    def _check_resume(self, state: dict[str, Any]) -> None:
        """Refuses what cannot be continued, before anything is built."""
        if "critic" not in state:
            raise CheckpointError("resume: an exported policy, without critic and optimizers; it cannot be continued")
        self._changed = problem_changes(state["config"], run_container(self.cfg))
        if self._changed and not self.cfg.resume_anyway:
            raise CheckpointError(
                f"resume: {', '.join(self._changed)}: not as in the run, which would be another experiment; leave that "
                "out, begin a new run, or say resume_anyway=true: networks and optimizers continue, in new episodes"
            )

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from what `save` wrote.

        With `cfg.resume_anyway` and a changed problem, networks, optimizers and counters continue, in new episodes.

        Raises:
            CheckpointError: for a checkpoint of another task or motion, of other networks or sizes of observations or
                actions, or of another number of environments, workers or ranks.
        """
        if state["task"] != self.task.name and not self._changed:
            raise CheckpointError(
                f"resume: a checkpoint of task {state['task']!r}, but the config says {self.task.name!r}"
            )
        if state.get("motion", self.motion_digest) != self.motion_digest and not self.cfg.resume_anyway:
            raise CheckpointError(
                f"resume: the motion {self.cfg.task.motion!r} is not the one of the run; set motion_root=FOLDER to "
                "where that is, or say resume_anyway=true"
            )
        if state["sizes"] != self.sizes:
            raise CheckpointError(f"resume: the checkpoint has sizes {state['sizes']}, the config {self.sizes}")
        if len(state["ranks"]) != self.ranks.size:
            raise CheckpointError(
                f"resume: the checkpoint is of {len(state['ranks'])} ranks (torchrun --nproc-per-node), "
                f"there are {self.ranks.size}"
            )
        own = state["ranks"][self.ranks.rank]
        try:
            self.actor.load_state_dict(state["training_actor"])
            self.averaged.module.load_state_dict(state["actor"])
            self.critic.load_state_dict(state["critic"])
        except RuntimeError as error:
            raise CheckpointError("resume: the checkpoint's networks are not those of the config's algo") from error
        self.actor_optim.load_state_dict(state["actor_optim"])
        self.critic_optim.load_state_dict(state["critic_optim"])
        for name, optimizer in (("actor_lr", self.actor_optim), ("critic_lr", self.critic_optim)):
            if self.cfg.algo[name] != state["config"]["algo"][name]:  # asked for; else as adapted so far
                for group in optimizer.param_groups:
                    group["lr"] = self.cfg.algo[name]
        self.iteration, self.frames, self.elapsed = state["iteration"], state["frames"], state["elapsed"]
        self.averaged.n_averaged.fill_(self.iteration)
        if not self._changed:
            self.collector.load_state_dict(own)
        torch.set_rng_state(own["rng"].cpu())


def make_trainer(cfg: DictConfig, folder: Path, evaluate: Evaluate | None = None) -> Trainer:
    """The trainer that a config's `algo.trainer` names; `Trainer` without one. Arguments are those of `Trainer`.

    Raises:
        ConfigError: if there is none of that name.
    """
    path = cfg.algo.get("trainer") or "hdmi.learning.Trainer"
    try:
        cls = get_object(path)
    except Exception as error:
        raise ConfigError(f"algo.trainer: there is no {path!r}: {one_line(error)}") from error
    if not (isinstance(cls, type) and issubclass(cls, Trainer)):
        raise ConfigError(f"algo.trainer: {path!r}: a Trainer expected")
    return cls(cfg, folder, evaluate)


@contextmanager
def _deferred_interrupt(wanted: bool) -> Iterator[Callable[[], bool]]:
    """Notes a first Ctrl-C or SIGTERM (a cluster takes its machine back), for the caller to ask for.

    A second one is a KeyboardInterrupt.

    Args:
        wanted: whether to do so; it is not done either for signals that are handled otherwise.
    """
    came = False

    def note(number: int, frame: Any) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True
        os.write(2, b"interrupted: ends after this iteration; once more ends it at once\n")  # print is not reentrant

    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    held = {number: handler for number, handler in usual.items() if signal.getsignal(number) is handler}
    if not wanted or threading.current_thread() is not threading.main_thread():
        held = {}
    for number in held:
        signal.signal(number, note)
    try:
        yield lambda: came
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)


class Objective(torch.nn.Module):
    """The loss to descend and its parts, as one module."""

    def __init__(self, loss: ClipPPOLoss):
        super().__init__()
        self.loss = loss

    def forward(self, minibatch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        losses = self.loss(minibatch)
        return losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"], losses


def _parallel(objective: torch.nn.Module) -> DistributedDataParallel:
    # running moments are averaged where they are updated; gradients need not be copied to be reduced
    return DistributedDataParallel(
        objective, broadcast_buffers=False, gradient_as_bucket_view=True,
        find_unused_parameters=getattr(objective, "in_turns", False),
    )  # fmt: skip


def _explained_variance(target: Tensor, value: Tensor) -> float:
    """Share of the variance of returns [n] that their estimates have."""
    return float(1 - (target - value).var() / (target.var() + 1e-8))


def _recent_mean(mean: Tensor, latest: Tensor, count: Tensor | int, share: float) -> Tensor:
    """A running mean over about the last `share` of the `count` values so far and the latest."""
    return mean + (latest - mean) / max(1.0, share * (int(count) + 1))


def summarize(batch: TensorDictBase) -> dict[str, float]:
    """Figures of a batch [N, T]: rewards by term, tracking errors, causes of termination, episodes that ended."""
    after = batch["next"]
    done = after["done"]
    ended = max(int(done.sum()), 1)
    row = {"reward": float(after["reward"].mean())}
    for name, value in after["reward_terms"].items():
        row[f"reward/{name}"] = float(value.mean())
    metrics = after.get("metrics", None)
    if metrics is not None:
        means = {name: float(value.mean()) for name, value in metrics.items()}
        if "contact_made" in means:
            row["contact_rate"] = means.pop("contact_made") / max(means.pop("contact_intended"), 1e-6)
        row |= means
    causes = after.get("termination", None)
    for name, value in () if causes is None else causes.items():
        row[f"termination/{name}"] = float((value & done).sum()) / ended
    row["diverged_worlds"] = int(after["diverged"].sum())
    row["episode_completed"] = float(after["completed"].sum()) / ended
    row["episodes"] = int(done.sum())
    if done.any():
        row["episode_return"] = float(after["episode_reward"][done].mean())
        row["episode_steps"] = float(after["step_count"][done].float().mean())
    return row


def _headline(row: dict[str, float]) -> str:
    parts = [f"reward {row['reward']:.3f}", f"steps {row.get('episode_steps', 0):.0f}"]
    parts.append(f"completed {row['episode_completed']:.0%}")
    if "contact_rate" in row:
        parts.append(f"contact {row['contact_rate']:.0%}")
    if "eval/success_rate" in row:
        parts.append(f"success {row['eval/success_rate']:.0%}")
    return "  ".join([*parts, f"{row['frames'] / 1e6:.2f}M frames", f"{row['train_sps']:.0f} steps/s"])
