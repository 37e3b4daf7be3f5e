"""Evaluates a checkpoint by the paper's protocol; prints the figures and writes eval.json.

    hdmi evaluate checkpoint=RUN [num_envs=256] [without=[NAME,...]] [terminations=all] [early_end=false] ...
    hdmi evaluate agent=zero|random [task=lift_box] [config_dir=FOLDER] ...
    hdmi evaluate policy=FILE.yaml task=NAME [motion_root=FOLDER] ...

`checkpoint` is a run folder (its newest checkpoint counts) or a checkpoint file. `terminations` are those that end
an episode as a failure: `all` that the policy was trained with, `none`, or a list such as
[root_pose,object_pose]; `without` takes some of them away: without=[lost_contact] is the paper's evaluation of the
interaction reward, on every task with contacts, without=[body_local_pose] that of the residual action. With
`early_end=true` what ended episodes early in the training (lever/early_end) ends them here, too;
`task_starts=true` takes the reset noise of the task instead of the training's (lever=close_starts). Errors are means
over the steps survived, and as `..._horizon` over the whole motion, in which the world goes on after a failure. An
agent instead of a checkpoint shows what a task is without a policy, in the environment of the default config;
`policy` is the description of a network of others, which runs there with its own gains. Figures of these, and of an
exported policy, are written only where `out` says.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rich.console import Console

from hdmi.assembly import make_task
from hdmi.commands.options import parse_options, parse_terminations
from hdmi.commands.script import run_script
from hdmi.config import ConfigError, choose_engine, task_config
from hdmi.deploy.format import DeploymentError
from hdmi.evaluation import EvalResult, evaluate_checkpoint, evaluate_policy
from hdmi.evaluation.agents import AGENTS, blind_agent


@dataclass
class Options:
    """See the module."""

    checkpoint: str | None = None
    agent: str | None = None
    policy: str | None = None  # a YAML: see docs/foreign.md
    num_envs: int = 256
    terminations: list[str] = field(default_factory=lambda: ["all"])
    without: list[str] = field(default_factory=list)  # names of terminations
    early_end: bool = False  # of a checkpoint
    task_starts: bool = False  # of a checkpoint
    seed: int = 0
    task: str | None = None  # for an agent: lift_box; for a checkpoint: that it must be of; for a policy: needed
    motion_root: str | None = None  # instead of the training's
    config_dir: str | None = None  # of an agent's or a policy's task, where conf/task lacks it
    num_threads: int | None = None  # of physics, instead of the training's
    sim: str | None = None  # engine, cpu or gpu; for a checkpoint: instead of the training's
    out: str | None = None  # file to write; of a run: instead of its eval.json


def evaluate_in_task(options: Options, terminations: list[str] | None, without: list[str]) -> EvalResult:
    """Evaluates what brings no config of its own, in that of a task: an agent, or a network of others."""
    if options.policy is not None and options.task is None:
        raise ConfigError("give task=NAME, in whose environment the policy is to be evaluated")
    cfg = task_config(options.task or "lift_box", options.motion_root, options.config_dir)
    if options.num_threads is not None:
        cfg.num_threads = options.num_threads
    if options.sim is not None:
        choose_engine(cfg, options.sim)
    if options.policy is not None:
        from hdmi.deploy.foreign.policy import ForeignPolicy  # of an extra
        from hdmi.evaluation.foreign import evaluate_foreign

        policy = ForeignPolicy(options.policy)
        result = evaluate_foreign(policy, cfg, options.num_envs, terminations, options.seed, without)
    else:
        task = make_task(cfg)
        agent = blind_agent(str(options.agent), cfg, task)
        result = evaluate_policy(agent, cfg, options.num_envs, task, terminations, options.seed, without)
    if options.out is not None:
        result.save(options.out)
    return result


def evaluate(arguments: list[str], console: Console) -> int:
    """Evaluates, and shows the figures."""
    options = parse_options(Options, arguments)
    if [options.checkpoint, options.agent, options.policy].count(None) != 2:
        raise ConfigError(f"give one of checkpoint=RUN, policy=FILE.yaml, or agent=, one of {', '.join(AGENTS)}")
    if options.num_envs < 1:
        raise ConfigError(f"num_envs: expected at least 1, got {options.num_envs}")
    terminations, without = parse_terminations(options.terminations), options.without
    if options.checkpoint is None:
        if options.early_end or options.task_starts:
            raise ConfigError("early_end, task_starts: only a checkpoint has had a training to differ from")
        result = evaluate_in_task(options, terminations, without)
    else:
        result = evaluate_checkpoint(
            options.checkpoint,
            options.num_envs,
            terminations,
            options.seed,
            options.out,
            options.task,
            options.motion_root,
            options.num_threads,
            options.sim,
            without,
            options.early_end,
            options.task_starts,
        )
    console.print(result.table())
    if result.path is not None:
        print(result.path)
    return 0


def main(arguments: list[str]) -> int:
    """Runs the script; returns its exit status."""
    return run_script(evaluate, arguments, __doc__, errors=(DeploymentError,))
