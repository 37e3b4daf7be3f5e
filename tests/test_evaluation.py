"""The evaluation protocol, its accounts, its files, and the scripts around it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import mujoco
import pytest
import torch
from mocks import command, lift_box, load_config
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from hdmi.assembly import make_env, make_transforms
from hdmi.assets import g1
from hdmi.config import ConfigError, task_config
from hdmi.envs.rendering import RenderingError, WorldRenderer
from hdmi.evaluation import EvalResult, evaluate_checkpoint, evaluate_policy, protocol, render_checkpoint, video
from hdmi.evaluation.agents import BlindAgent, blind_agent
from hdmi.evaluation.curves import groups_of, over_seeds, read_metrics
from hdmi.evaluation.protocol import FirstEpisodes, conditions, evaluation_config, task_starts_config, termination_names
from hdmi.learning.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from hdmi.learning.policy import load_policy, make_networks
from hdmi.transforms import ReferenceStateInitialization

ROOT = Path(__file__).parents[1]

FIGURES = (
    "success_rate", "survival", "joint_error", "body_error", "root_pos_error", "root_ori_error", "object_pos_error",
    "object_ori_error", "contact_rate",
)  # fmt: skip


def after(
    terminated: list[bool], diverged: list[bool] | None = None, flags: dict[str, list[bool]] | None = None, **metrics
) -> TensorDict:
    """The `next` of a step, by hand."""
    n = len(terminated)

    def column(values: list) -> torch.Tensor:
        return torch.tensor(values).reshape(n, 1)

    nested = {
        "terminated": column(terminated),
        "diverged": column(diverged or [False] * n),
        "metrics": {key: column(value) for key, value in metrics.items()},
        "termination": {key: column(value) for key, value in (flags or {}).items()},
    }
    return TensorDict(nested, batch_size=[n])


# -- accounts -------------------------------------------------------------------------------------------------


def test_only_environments_that_survive_every_step_succeed():
    episodes = FirstEpisodes(4, horizon=3, causes=["a"])
    episodes.add(after([False, True, False, False]))
    episodes.add(after([False, False, False, False], diverged=[False, False, True, False]))
    episodes.add(after([False, False, False, True]))  # at the last frame: still a failure
    assert episodes.success.tolist() == [True, False, False, False]
    assert episodes.values()["survival"].tolist() == pytest.approx([1, 0, 1 / 3, 2 / 3])
    assert episodes.summary()["success_rate"] == pytest.approx({"mean": 0.25, "std": 0.1875**0.5})


def test_an_unfinished_episode_is_no_success():
    episodes = FirstEpisodes(2, horizon=3)
    episodes.add(after([False, False]))
    assert not episodes.success.any()


def test_what_comes_after_the_first_episode_does_not_count():
    episodes = FirstEpisodes(2, horizon=3)
    episodes.add(after([True, False], joint_error=[1.0, 2.0]))
    for _ in range(2):
        episodes.add(after([False, False], joint_error=[100.0, 2.0]))
    assert episodes.values()["joint_error"].tolist() == [1.0, 2.0]
    assert episodes.success.tolist() == [False, True]


def test_metrics_average_over_the_steps_of_each_environment_then_over_environments():
    episodes = FirstEpisodes(2, horizon=4)
    for terminated, errors in (
        ([False, False], [0.2, 1.0]),
        ([True, False], [0.4, 2.0]),  # the step that terminates belongs to the episode
        ([False, False], [9.0, 3.0]),
        ([False, False], [9.0, 4.0]),
    ):
        episodes.add(after(terminated, joint_error=errors))
    assert episodes.values()["joint_error"].tolist() == pytest.approx([0.3, 2.5])
    assert episodes.summary()["joint_error"] == pytest.approx({"mean": 1.4, "std": 1.1})


def test_a_diverged_step_is_not_measured():
    episodes = FirstEpisodes(2, horizon=2)
    episodes.add(after([False, True], diverged=[False, True], joint_error=[0.5, float("nan")]))
    episodes.add(after([False, False], joint_error=[0.5, 0.5]))
    summary = episodes.summary()
    assert summary["joint_error"] == {"mean": 0.5, "std": 0.0}
    assert summary["termination_causes"] == {"diverged": 0.5}


def test_errors_over_the_whole_motion_go_on_after_the_end_and_stop_at_a_divergence():
    episodes = FirstEpisodes(3, horizon=4, causes=["a"])
    for terminated, diverged, errors in (
        ([True, False, False], [False, False, False], [1.0, 1.0, 1.0]),
        ([True, False, False], [False, False, False], [2.0, 1.0, 3.0]),
        ([False, False, True], [False, False, True], [3.0, 1.0, 99.0]),
        ([True, False, False], [False, False, False], [4.0, 1.0, 99.0]),  # a diverged world begins anew
    ):
        episodes.add(
            after(terminated, diverged, joint_error=errors, contact_made=[0.0] * 3, contact_intended=[0.0] * 3)
        )
    values = episodes.values()
    assert values["joint_error"].tolist() == [1.0, 1.0, 2.0]
    assert values["joint_error_horizon"].tolist() == pytest.approx([2.5, 1.0, (1 + 3 + 3 + 3) / 4])
    assert "contact_made_horizon" not in values
    summary = episodes.summary()
    assert summary["joint_error_horizon"]["mean"] == pytest.approx(2.0)
    assert summary["object_pos_error_horizon"] is None


def test_an_excused_termination_ends_nothing_by_itself():
    judged = FirstEpisodes(4, horizon=2, causes=["a"], excused=["b"])
    flags = {"a": [False, True, False, False], "b": [True, True, False, False]}
    judged.add(after([True, True, False, True], flags=flags))  # the last one by what has no name
    judged.add(after([False] * 4, flags={"a": [False] * 4, "b": [False] * 4}))
    assert judged.success.tolist() == [True, False, True, False]
    assert judged.summary()["termination_causes"] == {"diverged": 0.0, "a": 0.25, "other": 0.25}


def test_a_termination_that_the_environment_lacks_excuses_nothing():
    judged = FirstEpisodes(2, horizon=1, causes=["a"], excused=["b"])
    judged.add(after([True, False], flags={"a": [True, False]}))
    assert judged.success.tolist() == [False, True]


def test_contact_rate_is_made_over_intended_where_contact_is_intended():
    episodes = FirstEpisodes(3, horizon=3)
    episodes.add(after([False] * 3, contact_made=[0.0, 0.0, 0.0], contact_intended=[0.0, 0.0, 0.0]))
    episodes.add(after([False] * 3, contact_made=[0.5, 0.0, 0.0], contact_intended=[1.0, 1.0, 0.0]))
    episodes.add(after([False] * 3, contact_made=[1.0, 0.5, 0.0], contact_intended=[1.0, 1.0, 0.0]))
    assert episodes.summary()["contact_rate"] == pytest.approx({"mean": 0.5, "std": 0.25})


def test_figures_without_measurements_are_null():
    episodes = FirstEpisodes(1, horizon=1)
    episodes.add(after([False], contact_made=[0.0], contact_intended=[0.0], joint_error=[0.1]))
    summary = episodes.summary()
    assert summary["contact_rate"] is None
    assert summary["object_pos_error"] is None
    assert summary["joint_error"] is not None


def test_causes_share_out_the_failures_and_the_first_has_precedence():
    episodes = FirstEpisodes(5, horizon=4, causes=["a", "b"])
    episodes.add(after([False] * 5, flags={"a": [False] * 5, "b": [False] * 5}))
    both, b = [True, False, False, False, False], [True, True, False, False, False]
    episodes.add(after([True, True, False, False, True], flags={"a": both, "b": b}))
    # flags stay up after the end; they must not count again
    episodes.add(after([True, True, True, False, True], flags={"a": [True] * 5, "b": b}))
    episodes.add(after([False] * 5))
    summary = episodes.summary()
    assert summary["termination_causes"] == {"diverged": 0.0, "a": 0.4, "b": 0.2, "other": 0.2}
    assert summary["failure_frames"] == {"diverged": None, "a": 2.5, "b": 2.0, "other": 2.0}
    assert summary["success_rate"]["mean"] == pytest.approx(1 - 0.8)


# -- config ---------------------------------------------------------------------------------------------------


def test_the_protocol_starts_at_the_first_frame_and_keeps_what_was_trained():
    trained = load_config("reset=adaptive")
    cfg = evaluation_config(trained)
    assert cfg.reset.state._target_.endswith("ReferenceStateInitialization")
    assert cfg.reset.state.start == 0
    assert cfg.reset.state.noise == trained.reset.state.noise
    assert "bins" not in cfg.reset.state
    for group in ("randomization", "noise", "termination", "observation", "action"):
        assert cfg[group] == trained[group]
    assert "bins" in trained.reset.state


def test_the_protocol_is_without_the_aids_of_training():
    trained = load_config("+lever=[early_end,springs,springs_object,rewind,feedforward]")
    cfg = evaluation_config(trained)
    assert set(cfg.reset) == {"state"}
    assert cfg.early_end == cfg.assist == {}
    assert cfg.action == trained.action  # what the policy's actions mean stays
    assert cfg.reference == trained.reference
    assert termination_names(cfg) == termination_names(load_config())
    nodes = dict(make_transforms(cfg, lift_box()))
    assert not [name for name in nodes if name.startswith(("early_end", "assist")) or name == "reset.rewind"]
    assert "reference.target" in nodes
    assert set(trained.assist) == {"root", "object"}  # the config that was given is as it was
    assert "rewind" in trained.reset


def test_terminations_can_be_chosen():
    trained = load_config()
    assert termination_names(evaluation_config(trained)) == termination_names(trained)
    chosen = evaluation_config(trained, ["object_pose"])
    assert termination_names(chosen) == ["object_pose"]
    assert chosen.horizon == trained.horizon
    assert termination_names(evaluation_config(trained, [])) == []
    with pytest.raises(ConfigError, match=r"no \['falling'\]; there is \['root_pose'"):
        evaluation_config(trained, ["falling"])


@pytest.mark.parametrize(
    ("overrides", "without", "left"),
    [
        ([], ["lost_contact"], ["root_pose", "body_local_pose", "object_pose"]),
        (["task=open_foldchair_sit"], ["lost_contact"], ["root_pose", "body_local_pose", "object_joint"]),
        (["task=move_stool"], ["lost_contact"], None),
        ([], ["body_local_pose", "object_pose"], ["root_pose", "lost_contact"]),
        # a training that went without is evaluated like the others
        (["+ablation=no_interaction_reward_no_contact_termination"], ["lost_contact"], None),
    ],
)
def test_terminations_can_be_left_out(overrides: list[str], without: list[str], left: list[str] | None):
    trained = load_config(*overrides)
    chosen = termination_names(evaluation_config(trained, without=without))
    assert chosen == [name for name in termination_names(trained) if name not in without]
    assert left is None or chosen == left


def test_what_cannot_be_left_out_is_told():
    for task, name in (("walk", "lost_contact"), ("lift_box", "falling"), ("lift_box", "motion_end")):
        with pytest.raises(ConfigError, match=rf"without: the task has no \['{name}'\]; there is \['root_pose'"):
            evaluation_config(load_config(f"task={task}"), without=[name])
    chosen = evaluation_config(load_config(), ["root_pose", "lost_contact"], without=["lost_contact"])
    assert termination_names(chosen) == ["root_pose"]


def test_a_start_beyond_the_motion_is_refused():
    reference = lift_box().reference
    starts = ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=7)
    assert starts.sample_frames(torch.Size([3]), None).tolist() == [7, 7, 7]
    with pytest.raises(ValueError, match="expected a frame from 0 to"):
        ReferenceStateInitialization(reference, g1.JOINT_RANGES, start=reference.num_frames)


# -- environments ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cfg() -> DictConfig:
    return load_config("algo.actor_hidden=[8]", "algo.critic_hidden=[8]", "algo.bf16=false")


@pytest.fixture(scope="module")
def run(cfg: DictConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with an untrained policy."""
    env = make_env(cfg, 1, lift_box())
    spec = env.full_observation_spec
    sizes = {key: spec[key].shape[-1] for key in ("policy", "critic")} | {"action": env.action_spec.shape[-1]}
    env.close()
    torch.manual_seed(0)
    actor, _ = make_networks(cfg, sizes, torch.device("cpu"))
    folder = tmp_path_factory.mktemp("run")
    state = {
        "config": OmegaConf.to_container(cfg, resolve=True),
        "task": cfg.task.name, "sizes": sizes, "iteration": 3, "frames": 96, "elapsed": 120.0,
        "actor": actor.state_dict(), "critic": {},
    }  # fmt: skip
    save_checkpoint(folder / "checkpoints" / "checkpoint_000003.pt", state)
    return folder


def test_an_evaluation_leaves_its_figures_in_the_run_folder(run: Path):
    result = evaluate_checkpoint(run, num_envs=8, task="lift_box")
    assert result.path == run / "eval.json"
    saved = json.loads((run / "eval.json").read_text())
    assert saved == dict(result) == dict(EvalResult.load(run / "eval.json"))
    for name in FIGURES:
        assert saved[name] is None or set(saved[name]) == {"mean", "std"}, name
    assert saved["success_rate"]["mean"] + sum(saved["termination_causes"].values()) == pytest.approx(1)
    # some fail within the motion, and the reasons are the task's
    assert 0 < saved["survival"]["mean"] < 1
    assert saved["terminations"] == ["root_pose", "body_local_pose", "object_pose", "lost_contact"]
    assert set(saved["termination_causes"]) == {"diverged", *saved["terminations"]}
    expected = {"checkpoint": "checkpoints/checkpoint_000003.pt", "iteration": 3, "frames": 96, "task": "lift_box",
                "motion": "lift_box", "motion_frames": 300, "num_envs": 8, "seed": 0}  # fmt: skip
    assert expected.items() <= saved.items()
    assert result.table().row_count == len(result.figures()) + len(saved["termination_causes"])
    assert not list(run.glob("*.partial"))


def test_without_terminations_the_horizon_is_run_to_its_end(monkeypatch: pytest.MonkeyPatch):
    seen: list[int] = []

    class Counting(FirstEpisodes):
        def add(self, after) -> None:
            seen.append(int(after["step_count"].min()))
            super().add(after)

    monkeypatch.setattr(protocol, "FirstEpisodes", Counting)
    short = load_config("task.episode_steps=10", "algo.actor_hidden=[8]")
    actor = torch.nn.Module()  # zero actions: servos that follow the reference
    actor.forward = lambda td: td.set("action", torch.zeros(1, 23))  # type: ignore[method-assign]
    before = torch.get_rng_state()
    result = evaluate_policy(actor, short, 1, lift_box(), terminations=[])
    assert torch.equal(torch.get_rng_state(), before)
    assert seen == list(range(1, 300))
    assert result["success_rate"]["mean"] == 1.0
    assert result["terminations"] == []


def test_a_checkpoint_of_another_task_is_refused(run: Path):
    with pytest.raises(CheckpointError, match="'lift_box', not of 'push_box'"):
        evaluate_checkpoint(run, task="push_box")
    with pytest.raises(CheckpointError, match="'lift_box', not of 'push_box'"):
        render_checkpoint(run, task="push_box")


# -- videos ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("size", [(16, 2560), (1440, 32)])
def test_pictures_beyond_the_usual_sizes(size: tuple[int, int]):
    model = lift_box().scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = WorldRenderer(model, lift_box().scene.robot, 32, 32)
    assert renderer(model, data, *size).shape == (*size, 3)
    renderer.close()


@pytest.mark.parametrize("size", [(0, 64), (64, -1), (64, 100_000)])
def test_pictures_of_impossible_sizes(size: tuple[int, int]):
    with pytest.raises(RenderingError, match=f"pictures of {size[1]} x {size[0]} pixels: expected 1 to 8192"):
        WorldRenderer(lift_box().scene.model, lift_box().scene.robot, *size)


def short(moments: Iterator[video.Moment], count: int = 4) -> Iterator[video.Moment]:
    for moment, _ in zip(moments, range(count), strict=False):
        yield moment


@pytest.mark.usefixtures("gl")
def test_an_agent_is_evaluated_without_a_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "zero.json"
    assert command("evaluate").main(["agent=zero", "num_envs=4", "num_threads=1", f"out={out}"]) == 0
    figures = json.loads(out.read_text())
    assert figures["task"] == "lift_box"
    assert 0 <= figures["success_rate"]["mean"] <= 1
    # it stands and moves as the reference asks its servos to
    assert figures["body_error"]["mean"] < 0.1


@pytest.mark.slow
def test_an_agent_is_as_wide_as_the_environments_actions():
    """Whether there is a history of actions, and whatever that says."""
    nodes = ["action.history=null", "observation.policy.actions=null", "reward.action_rate=null"]
    cfg = load_config(*nodes)
    agent = blind_agent("zero", cfg, lift_box())
    assert agent.action_size == 23
    result = evaluate_policy(agent, cfg, 1, lift_box(), whole_motion=False)
    assert result["survival"]["mean"] > 0
    assert not [name for name in result if name.endswith("_horizon")]
    narrow = load_config()
    narrow.action.joint_position.scale = {".*_knee_joint": 0.3}
    assert blind_agent("random", narrow, lift_box()).action_size == 2


def test_blind_agents():
    batch = TensorDict({}, batch_size=[64])
    assert not BlindAgent("zero", 5)(batch)["action"].any()
    action = BlindAgent("random", 5)(batch)["action"]
    assert action.shape == (64, 5)
    assert -1 <= action.min() < -0.8
    assert 0.8 < action.max() <= 1


@pytest.mark.parametrize("agent", ["zero", "random", "reference"])
def test_agents_play_into_a_video(
    agent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    play = command("play")
    monkeypatch.setattr(play, "every", lambda moments, stride: short(moments))
    out = tmp_path / "videos" / "play.mp4"
    status = play.main([f"agent={agent}", f"out={out}", "width=128", "height=96", "start=150"])
    captured = capsys.readouterr()
    assert status == 0, captured.err
    assert captured.out.strip() == str(out)
    frames = imageio.mimread(out)
    assert len(frames) == 4
    assert frames[0].shape == (96, 128, 3)
    assert frames[0].std() > 10
    assert [path.name for path in out.parent.iterdir()] == ["play.mp4"]


@pytest.mark.usefixtures("gl")
def test_the_policy_of_a_run_is_rendered_into_its_folder(run: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(video, "every", lambda moments, stride: short(moments, 3))
    assert render_checkpoint(run, size=(96, 128)) == run / "video.mp4"
    assert len(imageio.mimread(run / "video.mp4")) == 3


@pytest.mark.usefixtures("gl")
def test_an_exported_policy_acts_like_its_checkpoint(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(video, "every", lambda moments, stride: short(moments, 3))
    out = tmp_path / "zoo" / "lift_box"
    assert command("export").main([f"checkpoint={run}", f"out={out}", "num_envs=2"]) == 0
    assert {path.name for path in out.iterdir()} == {
        "policy.pt", "policy.onnx", "scene.xml", "reference.npz", "config.yaml", "eval.json", "video.mp4", "README.md",
        "policy.yaml", "network.onnx", "motion",
    }  # fmt: skip
    original, exported = (load_policy(path)[0] for path in (run, out))
    assert original.state_dict().keys() == exported.state_dict().keys()
    for name, value in original.state_dict().items():
        assert torch.equal(value, exported.state_dict()[name]), name
    assert "critic" not in load_checkpoint(out)
    figures = json.loads((out / "eval.json").read_text())
    assert (figures["checkpoint"], figures["num_envs"], figures["frames"]) == ("policy.pt", 2, 96)
    before = (out / "eval.json").read_bytes()
    assert evaluate_checkpoint(out, num_envs=1).path is None  # its figures stay those of its card
    assert (out / "eval.json").read_bytes() == before
    card = (out / "README.md").read_text()
    assert card == capsys.readouterr().out[:-1]
    assert "after 96 frames, 2 minutes" in card
    assert "policy.onnx" in card
    assert f"| survival | {100 * figures['survival']['mean']:.1f} % |" in card


def test_early_ends_and_the_tasks_starts_are_conditions_of_their_own():
    plain, close = task_config("walk"), task_config("push_door_hand")
    close.reset.state.noise.root_pos = [0.02, 0.02, 0.005]
    assert list(conditions(plain)) == ["training", "early_end"]
    assert list(conditions(close)) == ["training", "early_end", "task_starts"]
    assert list(conditions(task_config("lift_box"))) == ["training"]
    assert set(termination_names(evaluation_config(plain))) == {"root_pose", "body_local_pose"}
    strict = evaluation_config(plain, early_end=True)
    assert set(termination_names(strict)) == {"root_pose", "body_local_pose", "early_root_pose", "early_body_pose"}
    assert list(strict.termination.early_root_pose.thresholds) == [0.25, 0.8]
    assert list(task_starts_config(close).reset.state.noise.root_pos) == [0.2, 0.2, 0.01]
    with pytest.raises(ConfigError, match="trained without early ends"):
        evaluation_config(task_config("lift_box"), early_end=True)


def test_each_condition_reaches_its_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    cfg = task_config("walk")
    cfg.reset.state.noise.joint_pos = 0.03
    save_checkpoint(tmp_path / "policy.pt", {"config": OmegaConf.to_container(cfg, resolve=True)})
    loaded = None, cfg, {"file": str(tmp_path / "policy.pt"), "iteration": 1, "frames": 2}
    monkeypatch.setattr(protocol, "load_checked_policy", lambda path, task: loaded)

    def note(actor, cfg, num_envs, **given):
        return {"noise": cfg.reset.state.noise.joint_pos, "early_end": given["early_end"], "seed": given["seed"]}

    monkeypatch.setattr(protocol, "evaluate_policy", note)
    results = protocol.evaluate_conditions(tmp_path, num_envs=4, seed=7, folder=tmp_path)
    assert {name: (one["noise"], one["early_end"]) for name, one in results.items()} == {
        "training": (0.03, False), "early_end": (0.03, True), "task_starts": (0.1, False),
    }  # fmt: skip
    for name, file in (("training", "eval.json"), ("task_starts", "eval_task_starts.json")):
        assert EvalResult.load(tmp_path / file)["noise"] == results[name]["noise"]
    assert {one["seed"] for one in results.values()} == {7}


def test_only_a_checkpoint_has_early_ends(capsys: pytest.CaptureFixture[str]):
    assert command("evaluate").main(["agent=zero", "early_end=true"]) == 2
    assert "only a checkpoint" in capsys.readouterr().err


def test_export_says_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert command("export").main([f"checkpoint={tmp_path}"]) == 2
    assert "give checkpoint=RUN and out=FOLDER" in capsys.readouterr().err
    assert command("export").main([f"checkpoint={tmp_path}", f"out={tmp_path}"]) == 2
    assert "no checkpoint_*.pt or policy.pt there" in capsys.readouterr().err


def test_play_stops_a_second_after_a_failure(cfg: DictConfig):
    def lash_out(td):
        return td.set("action", torch.full((1, 23), 4.0))

    moments = list(video.play_moments(cfg, lift_box(), lash_out))
    failed = [m.failure for m in moments if m.failure is not None]
    assert len(failed) == 50
    assert len(set(failed)) == 1
    assert [m.frame for m in moments] == list(range(len(moments)))


def test_the_reference_replays_from_any_frame():
    task = lift_box()
    moments = video.replay(task, 280)
    first = next(moments)
    assert first.frame == 280
    wrist = first.data.body("left_wrist_yaw_link").xpos
    row = list(task.scene.body_ids).index(first.model.body("left_wrist_yaw_link").id)
    assert wrist == pytest.approx(task.reference.body_pos[280, row].numpy(), abs=5e-3)
    assert 1 + sum(1 for _ in moments) == 20


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert command("play").main(["agent=reference", "window=true"]) == 2
    assert "needs a display" in capsys.readouterr().err


# -- mistakes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("evaluate", [], "give one of checkpoint=RUN, policy=FILE.yaml, or agent=, one of zero, random"),
        (
            "evaluate",
            ["agent=zero", "task=walk", "without=[lost_contact]"],
            "no ['lost_contact']; there is ['root_pose'",
        ),
        ("evaluate", ["agent=best"], "there is no 'best'; there is zero, random"),
        ("evaluate", ["checkpoint=nowhere"], "nowhere"),
        ("evaluate", ["run=nowhere"], "unknown option 'run'"),
        ("play", [], "give either checkpoint=RUN or agent="),
        ("play", ["agent=best"], "there is zero, random, reference"),
        ("play", ["agent=zero", "task=juggle"], "there is no 'juggle'; there is"),
        ("play", ["agent=zero", "start=300"], "expected a frame from 0 to 298"),
        ("play", ["agent=zero", "task=push_box", "motion_root=nowhere"], "not under nowhere"),
        ("plot", ["nowhere"], "no metrics.csv"),
    ],
)
def test_mistakes_end_scripts_with_one_line(
    name: str, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    assert command(name).main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1


# -- curves ---------------------------------------------------------------------------------------------------


def test_runs_are_plotted(tmp_path: Path):
    header = "iteration,frames,minutes,joint_error,eval/success_rate\n"
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(header + "0,100,0.5,0.3,\n1,200,1.0,0.2,0.5\n")
    out = tmp_path / "pictures" / "curves.png"
    assert command("plot").main([str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(out)]) == 0
    image = imageio.imread(out)
    assert image.shape[1] > 600
    assert image[..., :3].std() > 5


def test_runs_without_rows_are_left_out_of_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    header = "iteration,frames,minutes,joint_error\n"
    contents = {
        "good": header + "0,100,0.5,0.3\n1,200,1.0,0.2\n",
        "cut_off": header + "0,100,0.5,0.3\n1,2",
        "empty": "",
        "header": header,
        "first_row_cut_off": header + "0,10",
        "other": "a,b\n1,2\n",
    }
    for name, text in contents.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(text)
    (tmp_path / "absent").mkdir()
    names = [*contents, "absent"]
    out = tmp_path / "curves.png"
    assert command("plot").main([*(str(tmp_path / name) for name in names), "--out", str(out)]) == 0
    assert out.is_file()
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 5
    for name in ("empty", "header", "first_row_cut_off", "other", "absent"):
        assert any(line.startswith("left out: ") and f"/{name}" in line for line in told), name
    out.unlink()
    assert command("plot").main([*(str(tmp_path / name) for name in names[2:]), "--out", str(out)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not out.exists()
    table = read_metrics(tmp_path / "cut_off")
    assert table["frames"].tolist() == [100]


def test_runs_that_differ_in_the_seed_are_one_curve(tmp_path: Path):
    header = "iteration,frames,minutes,joint_error,eval/success_rate\n"
    for seed, error in ((0, 0.2), (1, 0.4)):
        run = tmp_path / f"seed{seed}"
        run.mkdir()
        rows = [f"{i},{100 * (i + 1)},{i + seed},{error},\n" for i in range(2 + seed)]
        (run / "metrics.csv").write_text(header + "".join(rows))
        overrides = [
            "task=walk",
            "motion_root=${oc.env:NOWHERE}",
            f"seed={seed}",
            f"run_name=seed{seed}",
            "video=false",
        ]
        OmegaConf.save(OmegaConf.create({"overrides": overrides}), run / "config.yaml")
    other = tmp_path / "other"
    other.mkdir()
    (other / "metrics.csv").write_text(header + "0,100,1,0.5,\n")
    runs = sorted(path for path in tmp_path.iterdir())
    # by what was typed, whether it can be looked up here or not
    assert groups_of(runs) == {"other": [other], "task=walk motion_root=${oc.env:NOWHERE}": runs[1:]}
    mean, band = over_seeds([read_metrics(run) for run in runs[1:]], "joint_error")
    assert mean.tolist() == pytest.approx([0.3, 0.3])
    assert band.tolist() == [[0.2, 0.2], [0.4, 0.4]]
    out = tmp_path / "curves.png"
    assert command("plot").main([*map(str, runs), "--seeds", "--out", str(out)]) == 0
    assert imageio.imread(out).shape[1] == 1300
