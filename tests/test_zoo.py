"""The zoo: what policies are trained with, the queue that trains them, and what they come to."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import pytest
from mocks import CONF

from hdmi.assembly import make_env
from hdmi.commands import tasks
from hdmi.config import ConfigError
from hdmi.evaluation import EvalResult
from hdmi.evaluation.card import export
from hdmi.evaluation.protocol import evaluation_config
from hdmi.learning.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from hdmi.learning.policy import load_policy
from hdmi.motion import find_motion, motion_digest
from hdmi.tasks.queue import LOG_FILE
from hdmi.tasks.training import Outcome, is_better, train_zoo
from hdmi.tasks.zoo import Entry, policies, read_recipes, render_sheet, zoo_markdown, zoo_rows

ZOO = CONF.parent / "zoo"
RECIPES = {"walk": ["task=walk", "total_frames=100"], "lift": ["task=lift_box", "total_frames=100"]}


def evaluation(success: float, survival: float = 0.0, num_envs: int = 256, frames: int = 100) -> EvalResult:
    """What an evaluation may have come to."""
    figures = {"success_rate": success, "survival": survival, "joint_error": 0.05, "body_error": 0.03}
    return EvalResult(
        {name: {"mean": value, "std": 0.0} for name, value in figures.items()}
        | {"object_pos_error": None, "task": "walk", "num_envs": num_envs, "seed": 0, "frames": frames}
        | {"termination_causes": {"root_pose": 1 - success, "diverged": 0.0}}
        | {"failure_frames": {"root_pose": 80.0, "diverged": None}}
    )


# -- recipes --------------------------------------------------------------------------------------------------


def test_recipes_are_arguments_of_train(tmp_path: Path):
    path = tmp_path / "recipes.yaml"
    path.write_text("walk: [task=walk, +lever=close_starts, total_frames=3_000_000]\n")
    assert read_recipes(path) == {"walk": ["task=walk", "+lever=close_starts", "total_frames=3_000_000"]}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no file there; recipes=FILE"),
        ("walk: [", "not YAML"),
        ("- walk", "expected lines such as walk:"),
        ("", "expected lines such as walk:"),
        ("walk: task=walk", "walk: expected a list of arguments"),
        ("walk: [task]", r"walk: expected a list of arguments such as \[task=walk\], got \['task'\]"),
    ],
)
def test_a_broken_recipe_is_named(tmp_path: Path, text: str | None, said: str):
    path = tmp_path / "recipes.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=said) as error:
        read_recipes(path)
    assert str(path) in str(error.value)


# -- the queue ------------------------------------------------------------------------------------------------


class Commands:
    """Stands in for `hdmi train`, `evaluate` and `export` in processes of their own; notes what was asked."""

    def __init__(self, success: dict[str, float], status: int = 0):
        self.success, self.status, self.calls = success, status, []

    def __call__(self, command: list[str], stdout: Any, **kwargs: Any) -> subprocess.CompletedProcess:
        assert command[:3] == [sys.executable, "-m", "hdmi"]
        verb, *arguments = command[3:]
        options = dict(argument.split("=", 1) for argument in arguments)
        self.calls.append((verb, options))
        if self.status:
            stdout.write("working\nConfigError: algo.clip: too large\n")
        elif verb == "train":
            place = options.get("resume") or f"{options['output_dir']}/{options['run_name']}"
            self.train(Path(place), [text for text in arguments if not text.startswith("resume=")], num_envs=8)
        elif verb == "evaluate":
            policy = Path(options["checkpoint"])
            frames = load_checkpoint(policy)["frames"]
            result = evaluation(self.success[policy.name], num_envs=int(options["num_envs"]), frames=frames)
            result.save(options.get("out", policy / "eval.json"))
        elif verb == "export":
            policy = Path(options["checkpoint"])
            evaluation(self.success[policy.name]).save(Path(options["out"]) / "eval.json")
        return subprocess.CompletedProcess(command, self.status)

    def train(self, run: Path, overrides: list[str], frames: int = 100, num_envs: int = 256) -> None:
        """Leaves what a training does."""
        config = {"total_frames": 100, "overrides": overrides}
        state = {"frames": frames, "config": config, "motion": "of today"}
        save_checkpoint(run / "checkpoints" / f"checkpoint_{frames:06d}.pt", state)
        evaluation(self.success[run.name], num_envs=num_envs, frames=frames).save(run / "eval.json")

    def verbs(self, name: str) -> list[str]:
        """What was asked for a policy, in order."""
        place = ("run_name", "resume", "checkpoint")
        return [verb for verb, options in self.calls if name in {Path(options.get(key, "")).name for key in place}]


def policy_in(folder: Path, success: float, motion: str) -> None:
    """A policy of a zoo and its evaluation."""
    save_checkpoint(folder / "policy.pt", {"config": {}, "motion": motion})
    evaluation(success, 0.95).save(folder / "eval.json")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Outcome]]:
    """Trains the recipes by `commands` into tmp_path/zoo."""

    def start(commands: Commands, **kwargs: Any) -> list[Outcome]:
        monkeypatch.setattr(subprocess, "run", commands)
        return train_zoo(RECIPES, tmp_path / "runs", tmp_path / "zoo", say=lambda text: None, **kwargs)

    return start


def test_policies_are_trained_evaluated_and_exported(run: Callable[..., list[Outcome]], tmp_path: Path):
    commands = Commands({"walk": 0.9, "lift": 1.0})
    outcomes = run(commands, extra=["seed=3"])
    assert {outcome.name: outcome.kept for outcome in outcomes} == {"walk": True, "lift": True}
    assert commands.verbs("walk") == ["train", "evaluate", "export"]  # the training's own evaluation has 8 episodes
    _verb, options = next(call for call in commands.calls if call[1].get("run_name") == "walk")
    assert options["seed"] == "3"
    assert options["total_frames"] == "100"
    assert EvalResult.load(tmp_path / "zoo" / "lift" / "eval.json")["success_rate"]["mean"] == 1.0


def test_only_what_is_better_is_taken_over(run: Callable[..., list[Outcome]], tmp_path: Path):
    for name in RECIPES:
        policy_in(tmp_path / "zoo" / name, 0.92, "of today")
    commands = Commands({"walk": 0.91, "lift": 0.93})
    outcomes = {outcome.name: outcome for outcome in run(commands)}
    assert not outcomes["walk"].kept
    assert str(outcomes["walk"]) == "walk: success 91.0 %, in the zoo 92.0 %: the zoo's stays"
    assert outcomes["lift"].kept
    assert commands.verbs("walk") == ["train", "evaluate"]
    assert EvalResult.load(tmp_path / "zoo" / "walk" / "eval.json")["success_rate"]["mean"] == 0.92


@pytest.mark.parametrize(("best", "expected"), [(0.95, 0.95), (0.85, 0.9)])
def test_the_best_on_the_way_may_be_better_than_the_last(
    run: Callable[..., list[Outcome]], tmp_path: Path, best: float, expected: float
):
    commands = Commands({"walk": 0.9, "lift": 1.0, "best.pt": best})
    commands.train(tmp_path / "runs" / "walk", RECIPES["walk"])
    file = tmp_path / "runs" / "walk" / "checkpoints" / "best.pt"
    save_checkpoint(file, {"frames": 60, "motion": "of today"})
    outcomes = {outcome.name: outcome for outcome in run(commands)}
    assert str(outcomes["walk"]) == f"walk: success {100 * expected:.1f} %: taken over"
    assert EvalResult.load(tmp_path / "zoo" / "walk" / "eval.json")["success_rate"]["mean"] == expected
    for name in RECIPES:
        policy_in(tmp_path / "zoo" / name, 1.0, "of today")
    run(commands)
    assert commands.verbs("best.pt").count("evaluate") == 1  # known by then
    save_checkpoint(file, {"frames": 80, "motion": "of today"})
    run(commands)
    assert commands.verbs("best.pt").count("evaluate") == 2


def test_a_policy_for_another_motion_gives_way(run: Callable[..., list[Outcome]], tmp_path: Path):
    policy_in(tmp_path / "zoo" / "walk", 0.98, "of yesterday")
    outcomes = {outcome.name: outcome for outcome in run(Commands({"walk": 0.91, "lift": 0.93}))}
    assert str(outcomes["walk"]) == "walk: success 91.0 %: taken over"


def test_what_has_ended_is_not_trained_again_and_the_rest_continues(run: Callable[..., list[Outcome]], tmp_path: Path):
    commands = Commands({"walk": 0.9, "lift": 1.0})
    commands.train(tmp_path / "runs" / "walk", RECIPES["walk"])
    commands.train(tmp_path / "runs" / "lift", RECIPES["lift"], frames=60)
    run(commands)
    assert commands.verbs("walk") == ["export"]
    _verb, options = commands.calls[[verb for verb, _ in commands.calls].index("train")]
    assert options["resume"] == str(tmp_path / "runs" / "lift")
    assert "run_name" not in options
    assert "output_dir" not in options


def test_a_run_of_another_recipe_continues_under_the_new_one(run: Callable[..., list[Outcome]], tmp_path: Path):
    commands = Commands({"walk": 0.9, "lift": 1.0})
    commands.train(tmp_path / "runs" / "walk", ["task=walk", "total_frames=50"])
    run(commands)
    assert commands.verbs("walk") == ["train", "evaluate", "export"]


def test_a_training_that_fails_says_why_and_others_go_on(run: Callable[..., list[Outcome]], tmp_path: Path):
    outcomes = run(Commands({}, status=2))
    assert {outcome.name for outcome in outcomes} == set(RECIPES)
    log = tmp_path / "runs" / "walk" / LOG_FILE
    said = f"walk: hdmi train ended with status 2, {log}: ConfigError: algo.clip: too large"
    assert said in [str(outcome) for outcome in outcomes]


def test_survival_decides_between_equals():
    assert is_better(evaluation(0.5, 0.8), evaluation(0.5, 0.7))
    assert not is_better(evaluation(0.5, 0.99), evaluation(0.6, 0.1))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "fly"], "no recipe for fly; there is walk"),
        (["train", "recipes=nowhere.yaml"], "nowhere.yaml: no file there"),
        (["zoo", "zoo=nowhere"], "nowhere: no folder with a policy.pt there"),
        (["zoo", "num_envs=0"], "num_envs: expected at least 1, got 0"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "zoo").mkdir()
    (tmp_path / "zoo" / "recipes.yaml").write_text("walk: [task=walk]\n")
    monkeypatch.chdir(tmp_path)
    assert tasks.main(arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("folder", sorted(ZOO.glob("*/policy.pt")), ids=lambda path: path.parent.name)
def test_policies_that_ship_are_for_the_motions_that_ship(folder: Path):
    state = load_checkpoint(folder)
    assert "output_dir" not in state["config"]
    assert "output_dir" not in (folder.parent / "config.yaml").read_text()
    if state["config"]["motion_root"] is None:
        assert state["motion"] == motion_digest(find_motion(state["config"]["task"]["motion"]))


@pytest.mark.slow
@pytest.mark.usefixtures("gl")
def test_a_zoo_is_trained_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    zoo = tmp_path / "zoo"
    zoo.mkdir()
    small = "num_envs=8, total_frames=64, algo.minibatches=2, eval_envs=2, eval_interval=1"
    (zoo / "recipes.yaml").write_text(f"stroll: [task=walk, {small}]\n")
    places = [f"zoo={zoo}", f"runs={tmp_path / 'runs'}", "num_envs=2"]
    assert tasks.main(["train", *places]) == 0
    assert "taken over" in capsys.readouterr().out
    files = {path.name for path in (zoo / "stroll").iterdir()}
    assert files == {
        "policy.pt", "config.yaml", "eval.json", "eval_early_end.json", "curve.png", "video.mp4", "README.md",
    }  # fmt: skip
    card = (zoo / "stroll" / "README.md").read_text()
    assert "its early ends, too" in card
    assert str(tmp_path / "runs") not in card
    export(tmp_path / "runs" / "stroll" / "checkpoints" / "best.pt", tmp_path / "best", num_envs=2)
    assert (tmp_path / "best" / "curve.png").is_file()
    page, sheet = tmp_path / "zoo.md", tmp_path / "zoo.jpg"
    assert tasks.main(["zoo", f"markdown={page}", f"sheet={sheet}", *places]) == 0
    assert "[`stroll`](zoo/stroll)" in page.read_text()
    assert imageio.imread(sheet).ndim == 3
    assert tasks.main(["train", *places]) == 0  # nothing is trained again
    assert "the zoo's stays" in capsys.readouterr().out


# -- what it comes to -----------------------------------------------------------------------------------------


def test_the_table_says_what_fails():
    walks = {"training": evaluation(0.75, 0.9), "early_end": evaluation(0.7), "task_starts": evaluation(0.5)}
    entries = [Entry("walk", 3_000_000, 16.4, walks), Entry("run", 10, 1, {"training": evaluation(1.0)})]
    first, second = zoo_rows(entries)
    assert first == [
        "walk", "3.0 M", "16", "75.0 %", "90.0 %", "70.0 %", "50.0 %", "0.050", "3.0", "",
        "root_pose 25.0 % (frame 80)",
    ]  # fmt: skip
    assert (second[5], second[6], second[10]) == ("", "", "")
    lines = zoo_markdown(entries, "../zoo").splitlines()
    assert lines[2].startswith("| [`walk`](../zoo/walk) | 3.0 M | 16 |")
    assert len({line.count("|") for line in lines}) == 1


def test_a_folder_without_policies_is_named(tmp_path: Path):
    with pytest.raises(CheckpointError, match=r"no folder with a policy\.pt there"):
        policies(tmp_path)


@pytest.mark.parametrize("name", policies(ZOO))
def test_the_zoo(name: str):
    """Its policies are of this package's format, small, act, have a recipe, and are what their cards say."""
    folder = ZOO / name
    actor, cfg, info = load_policy(folder)
    assert Path(info["file"]).stat().st_size < 2e6
    assert cfg.motion_root is None  # of no machine
    env = make_env(evaluation_config(cfg), 2)
    assert actor(env.reset())["action"].isfinite().all()
    figures = EvalResult.load(folder / "eval.json")
    assert (figures["frames"], figures["num_envs"]) == (info["frames"], 256)
    card = (folder / "README.md").read_text()
    assert f"| success_rate | {100 * figures['success_rate']['mean']:.1f} % |" in card
    assert set(read_recipes(ZOO / "recipes.yaml")[name]) <= set(cfg.overrides)


def test_a_contact_sheet_needs_a_picture_format(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"expected a \.jpg or \.png"):
        render_sheet(ZOO, ["walk"], tmp_path / "sheet.gif")
