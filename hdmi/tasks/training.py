"""Training a zoo: a queue of trainings that continues where it was interrupted, and keeps what is better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from hdmi.evaluation.protocol import EVAL_FILE, EvalResult, evaluation_file
from hdmi.learning.checkpoint import best_checkpoint, checkpoints, load_checkpoint
from hdmi.tasks.queue import run_hdmi, train_run
from hdmi.threads import share_of_processors

# Of every training of a zoo: policies are rendered when they are exported; every 0.6 M frames the best is kept.
_COMMON = ("video=false", "logger=csv", "eval_interval=150", "eval_envs=128")


@dataclass(frozen=True)
class Outcome:
    """What became of one policy's training.

    Args:
        name: of the policy.
        problem: what went wrong, empty if nothing did.
        result: the evaluation of what was trained.
        before: that of the policy that the zoo had, if any.
        kept: whether the new policy went into the zoo.
    """

    name: str
    problem: str = ""
    result: EvalResult | None = None
    before: EvalResult | None = None
    kept: bool = False

    def __str__(self) -> str:
        if self.problem or self.result is None:
            return f"{self.name}: {self.problem}"
        said = f"{self.name}: success {100 * self.result['success_rate']['mean']:.1f} %"
        if self.before is not None:
            said += f", in the zoo {100 * self.before['success_rate']['mean']:.1f} %"
        return said + (": taken over" if self.kept else ": the zoo's stays")


def is_better(new: Mapping, old: Mapping | None) -> bool:
    """Whether an evaluation beats another: by success, then by survival; any beats none.

    Examples:
        >>> a, b = ({"success_rate": {"mean": s}, "survival": {"mean": v}} for s, v in ((0.9, 0.92), (0.9, 0.95)))
        >>> is_better(b, a), is_better(a, a), is_better(a, None)
        (True, False, True)
    """
    if old is None:
        return True
    return _merit(new) > _merit(old)


def _merit(result: Mapping) -> tuple[float, float]:
    return result["success_rate"]["mean"], result["survival"]["mean"]


def train_zoo(
    recipes: Mapping[str, Sequence[str]],
    runs: str | Path,
    zoo: str | Path,
    jobs: int = 2,
    num_envs: int = 256,
    extra: Sequence[str] = (),
    say: Callable[[str], None] = print,
) -> list[Outcome]:
    """Trains policies, several at a time, each in processes of its own with its share of the processors.

    A training has the run folder `runs/<name>`: one that is there is continued, and one that has come to its end is
    not trained again. Of its last policy and the one that evaluated best on the way the better one is what was trained;
    it goes into `zoo/<name>` if it is better than what is there (`is_better`), or if what is there tracked another
    motion.

    Args:
        recipes: name of the policy -> arguments of `hdmi train`.
        runs, zoo: folders.
        jobs: trainings at a time.
        num_envs: episodes of an evaluation.
        extra: further arguments for all of them.
        say: takes what there is to tell, a line at a time.

    Returns:
        What became of each, in the order in which they ended.
    """
    threads = share_of_processors(jobs)
    outcomes: list[Outcome] = []
    with ThreadPoolExecutor(jobs) as pool:
        whole = {name: [*recipe, *extra] for name, recipe in recipes.items()}
        futures = [
            pool.submit(_train, name, whole[name], threads, num_envs, Path(runs), Path(zoo), say) for name in whole
        ]
        try:
            for future in as_completed(futures):
                outcomes.append(future.result())
                say(f"{len(outcomes)}/{len(recipes)} {outcomes[-1]}")
        except KeyboardInterrupt:  # trainings have had it, too, and write a checkpoint
            pool.shutdown(cancel_futures=True)
            raise
    return outcomes


def _train(
    name: str,
    recipe: Sequence[str],
    threads: int,
    num_envs: int,
    runs: Path,
    zoo: Path,
    say: Callable[[str], None],
) -> Outcome:
    run, folder = runs / name, zoo / name
    count = f"num_threads={threads}"
    if not _has_ended(run, recipe) and (problem := train_run(run, [*_COMMON, count, *recipe], say)):
        return Outcome(name, problem)
    if _episodes(run) != num_envs and (
        problem := run_hdmi(run, "evaluate", f"checkpoint={run}", f"num_envs={num_envs}", count)
    ):
        return Outcome(name, problem)
    result, checkpoint = EvalResult.load(run / EVAL_FILE), run
    best = best_checkpoint(run / "checkpoints")
    if best is not None:
        file = run / evaluation_file("best")
        arguments = (f"checkpoint={best}", f"num_envs={num_envs}", count, f"out={file}")
        if not _is_of(file, best, num_envs) and (problem := run_hdmi(run, "evaluate", *arguments)):
            return Outcome(name, problem, result)
        if is_better(EvalResult.load(file), result):
            result, checkpoint = EvalResult.load(file), best
    before = _in_zoo(folder, run)
    if not is_better(result, before):
        return Outcome(name, "", result, before)
    arguments = (f"checkpoint={checkpoint}", f"out={folder}", f"num_envs={num_envs}", "graph=false")
    if problem := run_hdmi(run, "export", *arguments):
        return Outcome(name, problem, result, before)
    return Outcome(name, "", result, before, kept=True)


def _in_zoo(folder: Path, run: Path) -> EvalResult | None:
    """The evaluation of a zoo's policy, if it tracked the motion that a run tracks: on another it says nothing."""
    if not (folder / EVAL_FILE).is_file():
        return None
    old, new = (load_checkpoint(path).get("motion") for path in (folder, run))
    return EvalResult.load(folder / EVAL_FILE) if old == new else None


def _has_ended(run: Path, recipe: Sequence[str]) -> bool:
    """Whether a run is of this recipe and has come to its end, evaluation included."""
    if not (run / EVAL_FILE).is_file() or not checkpoints(run / "checkpoints"):
        return False
    state = load_checkpoint(run)
    whole = EvalResult.load(run / EVAL_FILE).get("frames", 0) >= state["frames"] >= state["config"]["total_frames"]
    return whole and set(recipe) <= set(state["config"].get("overrides", ()))


def _is_of(file: Path, checkpoint: Path, num_envs: int) -> bool:
    """Whether a file holds the evaluation of a checkpoint over so many episodes."""
    if not file.is_file():
        return False
    result = EvalResult.load(file)
    return (result["num_envs"], result["frames"]) == (num_envs, load_checkpoint(checkpoint)["frames"])


def _episodes(run: Path) -> int:
    """Of how many episodes the evaluation of a run is; 0 without one."""
    return EvalResult.load(run / EVAL_FILE)["num_envs"] if (run / EVAL_FILE).is_file() else 0
