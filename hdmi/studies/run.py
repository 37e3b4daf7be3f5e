"""The queue of a study: trains what is missing, evaluates all of it, and repeats nothing."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from pathlib import Path

from hdmi.config import ConfigError
from hdmi.learning.checkpoint import CheckpointError
from hdmi.learning.policy import load_policy
from hdmi.learning.resume import of_training
from hdmi.motion import MotionError, save_motion
from hdmi.studies.measure import NONE, is_measured, measure_run, read_points, task_terminations_config
from hdmi.studies.plan import Job, Study
from hdmi.studies.rows import read_rows_of
from hdmi.tasks.queue import frames_left, overrides_of, train_run
from hdmi.threads import share_of_processors
from hdmi.workshop.recording import record_motion

# Of every training: the study evaluates and renders by itself.
_COMMON = ("video=false", "logger=csv", "eval_interval=0", "eval_envs=1")
_PROBLEMS = (CheckpointError, ConfigError, MotionError, OSError, RuntimeError)

Say = Callable[[str], None]


def check_jobs(jobs: Sequence[Job], runs: Path) -> dict[str, int]:
    """Composes the config of every training, and looks whether what is in its run folder is of it.

    Returns:
        Iterations between the checkpoints of each, by the name of its job.

    Raises:
        ConfigError: for arguments that cannot be composed, or a folder that holds a training of other arguments.
        CheckpointError: for a folder whose checkpoint cannot be used.
    """
    intervals = {}
    for job in jobs:
        cfg = job.config(_COMMON)
        iterations = -(-cfg.total_frames // (cfg.num_envs * cfg.algo.frames_per_env))
        intervals[job.name] = max(1, -(-iterations // job.study.points))
        run = runs / job.name
        if frames_left(run) is None:
            continue
        there, wanted = set(of_training(overrides_of(run))), set(job.arguments)
        differ = there ^ wanted
        if job.variant.reference is not None:  # its motion is the study's own recording
            differ = {text for text in differ if not text.startswith("motion_root=")}
        if differ:
            raise ConfigError(
                f"{run}: holds a training of other arguments ({', '.join(sorted(differ))}); choose another runs=FOLDER"
            )
    return intervals


def run_study(study: Study, runs: Path, folder: Path, jobs: int = 2, say: Say = print) -> dict[str, str]:
    """Trains and evaluates a study, several trainings at a time, each in a process of its own.

    What is there is not trained again, nor what the rows of an earlier report have; what was interrupted continues.
    Variants that are trained on a recorded motion come last: the best run of the variant that they name is played and
    recorded, once for each task.

    Args:
        runs: folder of the run folders, which studies may share.
        folder: of the report; recorded motions go into its `motions`.
        jobs: trainings at a time.
        say: takes what there is to tell, a line at a time.

    Returns:
        What went wrong, by the name of the job; the rest is there.

    Raises:
        ConfigError, CheckpointError: as `check_jobs`, before anything is trained.
    """
    reported = {row.job.name for row in read_rows_of(study, runs, folder) if row.folder is None}
    everything = [job for job in study.jobs if job.name not in reported]
    intervals = check_jobs(everything, runs)
    roots: dict[tuple[str, str], Path] = {}  # variant that is recorded, task -> motion root
    problems: dict[str, str] = {}
    for stage in (
        [job for job in everything if job.variant.reference is None],
        [job for job in everything if job.variant.reference is not None],
    ):
        ready: list[tuple[Job, Sequence[str]]] = []
        for job in stage:
            if job.variant.reference is None:
                ready.append((job, []))
                continue
            key = (job.variant.reference, job.task)
            try:
                if key not in roots:
                    roots[key] = _recorded(study, *key, runs, folder / "motions", say)
                ready.append((job, [f"motion_root={roots[key]}"]))
            except _PROBLEMS as error:
                problems[job.name] = f"no recorded motion: {error}"
                say(f"{job.name}: {problems[job.name]}")
        problems |= _train_all(ready, intervals, runs, jobs, say)
    return problems


def _train_all(
    jobs: Sequence[tuple[Job, Sequence[str]]], intervals: Mapping[str, int], runs: Path, at_once: int, say: Say
) -> dict[str, str]:
    """Trains and evaluates jobs, each with further arguments; returns what went wrong by the name of the job."""
    threads = share_of_processors(at_once)
    spawn = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    problems: dict[str, str] = {}
    with (
        ProcessPoolExecutor(at_once, spawn, initializer=_ignore_interrupts) as evaluators,
        ThreadPoolExecutor(at_once) as pool,
    ):

        def work(job: Job, extra: Sequence[str]) -> str:
            run, every = runs / job.name, intervals[job.name]
            own = [f"num_threads={threads}", f"checkpoint_interval={every}", f"keep_checkpoints={job.study.points + 1}"]
            if frames_left(run) != 0:
                arguments = [*_COMMON, *own, *job.arguments, *extra]
                if problem := train_run(run, arguments, say, job.name):
                    return problem
            if not is_measured(run, job.study.num_envs):
                evaluators.submit(measure_run, run, job.study.num_envs, threads).result()
            return ""

        futures: dict[Future[str], Job] = {pool.submit(work, job, extra): job for job, extra in jobs}
        try:
            for done, future in enumerate(as_completed(futures), 1):
                name = futures[future].name
                try:
                    problem = future.result()
                except _PROBLEMS as error:
                    problem = f"{type(error).__name__}: {error}"
                if problem:
                    problems[name] = problem
                say(f"{done}/{len(jobs)} {name}: {problem or 'done'}")
        except KeyboardInterrupt:  # trainings have had it, too, and write a checkpoint
            pool.shutdown(cancel_futures=True)
            raise
    return problems


def _ignore_interrupts() -> None:
    """In an evaluator: what it is at is finished; the process that waits for it ends the study."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _recorded(study: Study, variant: str, task: str, runs: Path, motions: Path, say: Say) -> Path:
    """The motion root of what the best run of a variant does, recorded unless it has been."""
    candidates = [runs / job.name for job in study.jobs if (job.variant.name, job.task) == (variant, task)]
    root = motions / f"{task}_{variant}"
    if any(root.glob("*/motion.npz")):
        return root
    best = max(candidates, key=_success)
    name = Job(study, study.variants[variant], task, 0).config().task.motion
    partial = root / f"{name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    policy, cfg, _ = load_policy(best)
    save_motion(record_motion(policy, task_terminations_config(cfg), name, points="effector"), partial)
    partial.rename(root / name)
    say(f"{task}: recorded {best}")
    return root


def _success(run: Path) -> float:
    points = read_points(run)
    return points[max(points)][NONE]["success_rate"]["mean"] if points else -1.0
