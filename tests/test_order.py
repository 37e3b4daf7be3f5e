"""Order that carries meaning: each rule broken once on purpose, and everything that ships keeps them."""

from __future__ import annotations

import pytest
import torch
from mocks import CONF, ScriptedEnv, lift_box, load_config, make_script
from torchrl.envs import InitTracker, RewardSum, StepCounter, Transform

from hdmi import transforms as T
from hdmi.assembly import make_env, make_task, make_transforms
from hdmi.assets import g1
from hdmi.config import ConfigError, task_files
from hdmi.envs import HumanoidObjectEnv
from hdmi.order import RULES, Stack, check_order, check_reads

ABLATIONS, LEVERS = (sorted(path.stem for path in (CONF / group).glob("*.yaml")) for group in ("ablation", "lever"))


def term(name: str, key: str = "speed") -> T.RewardTerm:
    return T.ActionRateL2(name, history_key=key)


def mass(bodies: str, per: str) -> Transform:
    return T.MassRandomization(lift_box().scene.model, [bodies], scale=[0.9, 1.1], per=per)


def starts(adaptive: bool = False) -> Transform:
    cls = T.AdaptiveStateInitialization if adaptive else T.ReferenceStateInitialization
    return cls(lift_box().reference, g1.JOINT_RANGES)


def noise(key: str = "x") -> Transform:
    return T.UniformNoise(("obs", key), 0.1)


def history(key: str = "x") -> Transform:
    return T.History(("obs", key), 2)


def joints() -> Transform:
    return T.JointPositionAction({".*": 0.5}, g1.JOINT_NAMES)


def failure() -> Transform:
    return T.ErrorTermination("far", ["miss"], [0.5])


def policy(*keys: str) -> Transform:
    return T.Concatenate(["terms"], "policy", {"terms": [("obs", key) for key in keys]})


# what stands too early, what has to stand before it, and why
WRONG: dict[str, tuple[Transform, Transform, str]] = {
    "size": (T.ObjectScale([0.9, 1.1]), starts(), "starts have to know the size"),
    "adaptive": (T.ObjectScale([0.9, 1.1]), starts(adaptive=True), "starts have to know the size"),
    "rewind": (T.Rewind(), starts(), "starts have to know the frame"),
    "curriculum": (T.ResetNoiseCurriculum(20), starts(), "how much they are perturbed"),
    "worlds": (mass("box", "world"), mass("pelvis", "episode"), "untouched model"),
    "delay": (T.ActionSmoothing(), T.ActionDelay([1, 2], 4), "the last thing that happens to a target"),
    "late offsets": (T.ResidualAction(), T.ActionDelay([1, 2], 4), "targets that are delayed"),
    "smooth offsets": (T.DefaultPoseAction([0.0]), T.ActionSmoothing(), "targets that are smoothed"),
    "target": (joints(), T.ResidualAction(), "makes joint angles"),
    "default": (joints(), T.DefaultPoseAction([0.0]), "makes joint angles"),
    "offset": (joints(), T.JointOffset(0.01), "makes joint angles"),
    "survival": (T.SurvivalReward(), failure(), "`terminated`"),
    "end": (T.MotionEnd(lift_box().reference), failure(), "`terminated`"),
    "rate": (T.RewardRate(0.02), term("late"), "a second of the others"),
    "group": (T.RewardGroups({}, {}), term("late"), "in no group"),
    "return": (RewardSum(in_keys=["reward"], out_keys=["sum"]), term("late"), "return"),
    "rate of return": (RewardSum(in_keys=["reward"], out_keys=["sum"]), T.RewardRate(0.02), "return"),
    "noise": (history(), noise(), "perturbed anew"),
    "episode noise": (history(), T.EpisodeNoise(("obs", "x"), 0.1), "perturbed anew"),
    "heading": (history(), T.HeadingNoise(("obs", "x"), 0.1), "perturbed anew"),
    "unseen noise": (policy("x", "y"), noise("y"), "nothing after it reads"),
    "unseen history": (policy("x", "y"), history("y"), "nothing after it reads"),
}


@pytest.mark.parametrize("case", WRONG)
def test_both_nodes_are_named(case: str):
    early, late, why = WRONG[case]
    names = f"a.late ({type(late).__name__}) has to stand before b.early ({type(early).__name__}): "
    clock = ("c.clock", T.MotionReference(lift_box().reference, ["pelvis"], [".*"], g1.BODY_NAMES, g1.JOINT_NAMES))
    with pytest.raises(ConfigError) as told:
        check_order([("b.early", early), clock, ("a.late", late)])
    assert str(told.value).startswith(f"stack: {names}")
    assert why in str(told.value)
    check_order([("a.late", late), clock, ("b.early", early)])


def test_every_rule_is_broken_by_some_case():
    stacks: list[Stack] = [[("b", early), ("a", late)] for early, late, _ in WRONG.values()]
    stacks.append([("reset.state", starts(adaptive=True))])
    for rule in RULES:
        assert any(rule(stack) for stack in stacks), rule


def test_adaptive_starts_need_the_motion_clock():
    with pytest.raises(ConfigError, match=r"reset\.state \(AdaptiveStateInitialization\) counts failures by .*'step'"):
        make_transforms(load_config("reset=adaptive", "stack=[reset]"), lift_box())
    make_transforms(load_config("reset=adaptive", "stack=[reset,reference]"), lift_box())


def test_what_has_nothing_to_do_with_each_other_stands_anywhere():
    model = lift_box().scene.model
    shifted = T.CenterOfMassRandomization(model, ["pelvis"], 0.01, per="world")
    check_order([("a", shifted), ("b", mass("box", "episode"))])  # of another field
    check_order([("a", history("x")), ("b", noise("y"))])  # of another entry
    check_order([("a", term("first")), ("b", failure())])  # does not read what ends an episode
    check_order([("a", noise()), ("b", history()), ("c", policy("x"))])
    check_order([("a", policy("x")), ("b", noise()), ("c", policy("x"))])  # the second one sees it


class TestReads:
    """On an environment that has `clock` and `obs/x`."""

    def check(self, *stack: tuple[str, Transform]) -> None:
        check_reads(stack, ScriptedEnv(make_script([("obs", "x"), "action_history"])))

    def test_of_what_is_there(self):
        self.check(
            ("a.copy", T.Flatten(("obs", "x"), ("obs", "z"))), ("b.noise", noise("z")), ("c.rate", T.RewardRate(1))
        )
        self.check(("a", T.ResidualAction("clock")), ("b", T.SurvivalReward()))

    def test_of_what_comes_later(self):
        told = (
            r"^stack: a\.noise \(UniformNoise\) reads \('obs', 'z'\), which b\.copy \(Flatten\) writes only after it: "
            r"b\.copy \(Flatten\) has to stand before$"
        )
        with pytest.raises(ConfigError, match=told):
            self.check(("a.noise", noise("z")), ("b.copy", T.Flatten("clock", ("obs", "z"))))

    def test_of_state_that_comes_later(self):
        feet = T.FeetState(0.02)
        with pytest.raises(ConfigError, match=r"a\.impact .*'force'\), which b\.feet \(FeetState\) writes only after"):
            self.check(("a.impact", T.FeetImpactL2(35.0)), ("b.feet", feet))

    @pytest.mark.parametrize("reader", [noise("z"), T.ResidualAction(("obs", "z")), T.FeetImpactL2(35.0)])
    def test_of_what_nothing_writes(self, reader: Transform):
        with pytest.raises(ConfigError, match=r"^stack: a\.node \(\w+\) reads .*, which nothing before it writes$"):
            self.check(("a.node", reader))

    def test_behind_what_finds_its_keys_in_an_environment(self):
        reader = ("c.flat", T.Flatten("step_count", ("obs", "z")))
        self.check(("a.count", StepCounter()), reader)
        self.check(("a.init", InitTracker()), ("b.flat", T.Flatten("is_init", ("obs", "z"))))
        with pytest.raises(ConfigError, match=r"c\.flat .*'step_count', which d\.count \(StepCounter\) writes only"):
            self.check(("a.init", InitTracker()), reader, ("d.count", StepCounter()))

    def test_draws_no_random_numbers(self):
        torch.manual_seed(0)
        before = torch.get_rng_state()
        self.check(("a", T.JointOffset(0.1)), ("b", T.ActionSmoothing()))
        assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "stack=[randomization,reset,reference]",
            r"reset\.state \(ReferenceStateInitialization\) has to stand before randomization\.object_scale",
        ),
        (
            "stack=[reference,tracking,action,observation.policy,history,noise]",
            r"noise\.root_ang_vel \(UniformNoise\) has to stand before history\.root_ang_vel \(History\)",
        ),
        (
            "stack=[reference,tracking,horizon,termination]",
            r"termination\.root_pose \(ErrorTermination\) has to stand before horizon\.motion_end \(MotionEnd\)",
        ),
        (
            "stack=[tracking,reference]",
            r"tracking\.contact_points \(ContactPoints\) reads \('ref', 'contact_point'\), which reference\.motion",
        ),
        (
            "stack=[action,reference]",
            r"action\.target \(ResidualAction\) reads \('ref', 'joint_target'\), which reference\.target",
        ),
        ("tracking.feet=null", r"reward\.feet_impact \(FeetImpactL2\) reads \('feet', 'force'\), which nothing"),
    ],
)
def test_configs_are_refused_by_name(override: str, message: str):
    with pytest.raises(ConfigError, match=message):
        make_env(load_config(override), 2, lift_box())


@pytest.mark.parametrize(
    "overrides",
    [
        *([f"+ablation={name}"] for name in ABLATIONS),
        ["reset=adaptive"],
        ["randomization=hdmi_push"],
        ["reward=hdmi_survival"],
        ["reward=hdmi_2025"],
    ],
    ids=" ".join,
)
def test_variants_that_ship_pass(overrides: list[str]):
    check_reads(make_transforms(load_config(*overrides), lift_box()), HumanoidObjectEnv(lift_box().scene, 1))


@pytest.mark.parametrize("name", task_files())
def test_tasks_pass(name: str, monkeypatch: pytest.MonkeyPatch):
    """Alone, and with everything that may be added."""
    # seconds, and no node depends on them
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)
    monkeypatch.setattr("hdmi.assembly.reference_torque", lambda _, reference, grip: reference.joint_pos.numpy())
    task = make_task(load_config(f"task={name}"))
    base = HumanoidObjectEnv(task.scene, 1)
    levers = [lever for lever in LEVERS if lever != "springs_object" or task.scene.object_free_dof is not None]
    added = ["reset=adaptive", "randomization=hdmi_push", "reward=hdmi_survival", f"+lever=[{','.join(levers)}]"]
    for more in ([], added):
        check_reads(make_transforms(load_config(f"task={name}", *more), task), base)


@pytest.mark.parametrize("name", ["walk", "push_door_hand"])
def test_springs_pull_no_object_that_cannot_move(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("hdmi.assembly.start_tables", lambda *_: None)
    cfg = load_config(f"task={name}", "+lever=springs_object")
    with pytest.raises(
        ConfigError, match=rf"^assist\.object \(SpringAssist\): .*motion '{name}' has no object that can be pulled"
    ):
        make_transforms(cfg, make_task(cfg))


def test_a_task_may_add_terms_of_its_own():
    """New nodes come last in their groups, which is early enough."""
    cfg = load_config(
        "+reward.mine={_target_: hdmi.transforms.JointVelL2, weight: -1}",
        "+termination.mine={_target_: hdmi.transforms.BodyHeight, body: torso_link}",
        "+observation.policy.mine={_target_: hdmi.transforms.Flatten, in_key: [robot, root_pos], out_key: [obs, mine]}",
        "+noise.mine={_target_: hdmi.transforms.UniformNoise, key: [obs, joint_pos], scale: 0.1}",
        "+history.mine={_target_: hdmi.transforms.History, key: [obs, mine], steps: 1}",
    )
    env, plain = make_env(cfg, 2, lift_box()), make_env(load_config(), 2, lift_box())
    wider = [
        env.observation_spec[key].shape[-1] - plain.observation_spec[key].shape[-1] for key in ("policy", "critic")
    ]
    assert wider == [6, 3]
    assert env.rollout(2)["next", "reward"].isfinite().all()
