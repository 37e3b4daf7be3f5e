"""What TorchRL requires of a transform, for every transform of the package on an environment with only its keys."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from mocks import ScriptedEnv, assert_same, constant, drive, lift_box, make_script, wrap
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

import hdmi.functional as F
import hdmi.transforms as T
from hdmi.assets import Effector, default_joint_pos, g1

N = 3
EFFECTORS = (
    Effector(body="left_wrist_yaw_link", point=(0.1, 0.0, 0.0), target=(0.0, 0.1, 0.0)),
    Effector(body="right_wrist_yaw_link", point=(0.1, 0.0, 0.0), target=(0.0, -0.1, 0.0)),
)
JOINTS = ("a_joint", "b_joint", "c_joint", "d_joint")

ROBOT_BODY = tuple(("robot", f"body_{key}") for key in ("pos", "quat", "lin_vel", "ang_vel"))
ROOT = (("robot", "root_pos"), ("robot", "root_quat"))
MOVING_ROOT = (*ROOT, ("robot", "root_lin_vel"), ("robot", "root_ang_vel"))
CONTACT = (("contact", "eef_pos"), ("contact", "target_pos"), ("contact", "force"), ("ref", "contact"))
X, Y, POSE = ("obs", "x"), ("obs", "y"), ("obs", "pose")
QUAT = ROBOT_BODY[1]


Rename = Callable[[NestedKey], NestedKey]


@dataclass(frozen=True)
class Case:
    """How to make a transform, and what it must find.

    build: makes it from the required keys, which go through `r`, and keywords for the other ones.
    kind: `function` of the entries of one step; `reward` of those of the next step; `inverse`, rewrites the action
    or adds to it; `state`, carries state from step to step; `init`, writes what the environment resets to.
    random: draws numbers. ends: may end episodes.
    """

    build: Callable[..., Transform]
    kind: str
    reads: tuple[NestedKey, ...] = ()
    random: bool = False
    ends: bool = False

    def make(self) -> Transform:
        """With the keys that it has by default."""
        return self.build(lambda key: key)


def lazy(name: str, **kwargs) -> Callable[..., Transform]:
    """A transform that needs the model or the reference of the embedded task."""

    def build(r: Rename, **keys) -> Transform:
        cls = getattr(T, name)
        task = lift_box()
        given = {
            "model": task.scene.model,
            "reference": task.reference,
            "body_names": g1.BODY_NAMES,
            "joint_names": g1.JOINT_NAMES,
            "joint_ranges": g1.JOINT_RANGES,
        }
        parameters = cls.__init__.__code__.co_varnames[: cls.__init__.__code__.co_argcount]
        wanted = {key: value for key, value in given.items() if key in parameters}
        return cls(**wanted, **kwargs, **keys)

    return build


def motion_end(r: Rename, **keys) -> Transform:
    end = T.MotionEnd(lift_box().reference, **keys)
    end.last = 5
    return end


def feedforward(r: Rename, **keys) -> Transform:
    reference, servo = lift_box().reference, [50.0] * 29
    return T.FeedForwardTarget(reference, torch.ones_like(reference.joint_pos), servo, servo, servo, **keys)


def spring(r: Rename, **keys) -> Transform:
    state = [r(key) for key in MOVING_ROOT]
    return T.SpringAssist(lift_box().reference, robot_mass=35.0, total_steps=20, state_keys=state, **keys)


def object_joint(r: Rename, **keys) -> Transform:
    # any hinge will do; the embedded object has none
    return T.ObjectJointRandomization(lift_box().scene.model, "waist_yaw_joint", [0.1, 0.2], [0.3, 0.4], **keys)


ERRORS = (("error", "many"), ("error", "one"))
CASES: dict[str, Case] = {
    "AbsoluteDifference": Case(
        lambda r, **k: T.AbsoluteDifference(r(X), r(Y), r("out"), [0, 2], **k), "function", (X, Y)
    ),
    "ActionDelay": Case(lambda r, **k: T.ActionDelay((2, 6), 4, **k), "state", random=True),
    "ActionHistory": Case(
        lambda r, **k: T.ActionHistory(3, **({"action_key": "action"} | k | {"action_key": r("action")})), "state"
    ),
    "ActionRateL2": Case(lambda r, **k: T.ActionRateL2(**k), "reward", ("action_history",)),
    "ActionSmoothing": Case(lambda r, **k: T.ActionSmoothing(**k), "state", random=True),
    "AdaptiveStateInitialization": Case(
        lazy("AdaptiveStateInitialization", lead=0), "init", (("ref", "step"),), random=True
    ),
    "Angle": Case(lambda r, **k: T.Angle(r(QUAT), r(QUAT), r("out"), **k), "function", (QUAT,)),
    "BodyHeight": Case(
        lambda r, **k: T.BodyHeight("torso_link", g1.BODY_NAMES, threshold=0.5, min_steps=2, **k),
        "state",
        (ROBOT_BODY[0],),
        ends=True,
    ),
    "BodyHeightError": Case(
        lambda r, **k: T.BodyHeightError("a", ["a", "b"], ("a", "b", "c"), **k),
        "function",
        (("tracked", "body_pos"), ("ref", "body_pos")),
    ),
    "CenterOfMassRandomization": Case(
        lazy("CenterOfMassRandomization", bodies=["pelvis"], shift=0.1), "init", random=True
    ),
    "ContactMade": Case(lambda r, **k: T.ContactMade(**k), "function", CONTACT[2:]),
    "Concatenate": Case(
        lambda r, **k: T.Concatenate(["first", "second"], r("out"), {"first": [r(X)], "second": [r(Y)]}, **k),
        "function",
        (X, Y),
    ),
    "ContactPoints": Case(
        lambda r, **k: T.ContactPoints(EFFECTORS, g1.BODY_NAMES, **k),
        "function",
        (
            *ROBOT_BODY[:2],
            ("object", "link_pos"),
            ("object", "link_quat"),
            ("object", "scale"),
            ("ref", "contact_point"),
        ),
    ),
    "DefaultPoseAction": Case(lambda r, **k: T.DefaultPoseAction([0.1, 0.2, 0.3, 0.4], **k), "inverse"),
    "Difference": Case(lambda r, **k: T.Difference(r(X), r(Y), r("out"), **k), "function", (X, Y)),
    "Distance": Case(lambda r, **k: T.Distance(r(CONTACT[0]), r(CONTACT[1]), r("out"), **k), "function", CONTACT[:2]),
    "EpisodeNoise": Case(lambda r, **k: T.EpisodeNoise(r(X), 0.1, **k), "state", (X,), random=True),
    "ErrorTermination": Case(
        lambda r, **k: T.ErrorTermination("error", [r(e) for e in ERRORS], [1.5, 0.8], min_steps=2, **k),
        "state",
        ERRORS,
        ends=True,
    ),
    "FeedForwardTarget": Case(feedforward, "function", (("ref", "step"),)),
    "FeetAirTime": Case(lambda r, **k: T.FeetAirTime(**k), "reward", (("feet", "swing_time"), ("feet", "touchdown"))),
    "FeetImpactL2": Case(
        lambda r, **k: T.FeetImpactL2(35.0, **k), "reward", (("feet", "force"), ("feet", "previous_force"))
    ),
    "FeetSlip": Case(
        lambda r, **k: T.FeetSlip(g1.FEET, g1.BODY_NAMES, force_threshold=0.5, **k),
        "reward",
        (("robot", "body_lin_vel"), ("robot", "foot_force")),
    ),
    "FeetStumble": Case(lambda r, **k: T.FeetStumble(ratio=1.0, **k), "reward", (("robot", "foot_force"),)),
    "FeetState": Case(lambda r, **k: T.FeetState(0.02, force_threshold=1.5, **k), "state", (("robot", "foot_force"),)),
    "Flatten": Case(lambda r, **k: T.Flatten(r(CONTACT[2]), r("out"), **k), "function", (CONTACT[2],)),
    "FrictionRandomization": Case(
        lazy("FrictionRandomization", bodies=["pelvis"], friction=[0.5, 1.0]), "init", random=True
    ),
    "HeadingNoise": Case(lambda r, **k: T.HeadingNoise(r(POSE), 0.1, **k), "function", (POSE,), random=True),
    "History": Case(lambda r, **k: T.History(r(X), 2, **k), "state", (X,)),
    "InteractionReward": Case(lambda r, **k: T.InteractionReward(**k), "reward", CONTACT),
    "JointErrors": Case(
        lambda r, **k: T.JointErrors(r(X), r(Y), r("out"), ["[ac]_joint"], (*JOINTS, "e_joint"), **k),
        "function",
        (X, Y),
    ),
    "JointOffset": Case(lambda r, **k: T.JointOffset(0.1, **k), "state", random=True),
    "JointPosLimitsL1": Case(
        lambda r, **k: T.JointPosLimitsL1(g1.JOINT_RANGES, **k), "reward", (("robot", "joint_pos"),)
    ),
    "JointPositionAction": Case(lambda r, **k: T.JointPositionAction({"[ac]_joint": 0.5}, JOINTS, **k), "inverse"),
    "JointTorqueLimitsL1": Case(
        lambda r, **k: T.JointTorqueLimitsL1([0.5] * 29, **k), "reward", (("robot", "joint_torque"),)
    ),
    "JointVelL2": Case(lambda r, **k: T.JointVelL2(**k), "reward", (("robot", "joint_vel"),)),
    "KernelReward": Case(
        lambda r, **k: T.KernelReward("hdmi.functional.tracking", [r(("error", "many"))], "near", 2.0, sigma=0.5, **k),
        "reward",
        (("error", "many"),),
    ),
    "KernelTermination": Case(
        lambda r, **k: T.KernelTermination(
            F.any_error_exceeds, [r(e) for e in ERRORS], "far", 2, thresholds=(1.5, 0.8), **k
        ),
        "state",
        ERRORS,
        ends=True,
    ),
    "LostContact": Case(lambda r, **k: T.LostContact(min_force=2.0, min_steps=2, **k), "state", CONTACT, ends=True),
    "MassRandomization": Case(lazy("MassRandomization", bodies=["pelvis"], scale=[0.5, 2.0]), "init", random=True),
    "Metrics": Case(
        lambda r, **k: T.Metrics({"many": r(("error", "many")), "absent": None}, **k), "function", (("error", "many"),)
    ),
    "MotionEnd": Case(motion_end, "state", (("ref", "step"),), ends=True),
    "MotionReference": Case(
        lazy("MotionReference", tracked_bodies=["pelvis", "torso_link"], tracked_joints=["waist_.*"]), "state"
    ),
    "ObjectJointRandomization": Case(object_joint, "init", random=True),
    "ObjectScale": Case(lambda r, **k: T.ObjectScale([0.9, 1.1], **k), "init", random=True),
    "PointInRoot": Case(lambda r, **k: T.PointInRoot(r(CONTACT[0]), r("out"), **k), "function", (CONTACT[0], *ROOT)),
    "PoseInRoot": Case(
        lambda r, **k: T.PoseInRoot(r(("object", "pos")), r(("object", "quat")), r("out"), **k),
        "function",
        (("object", "pos"), ("object", "quat"), *ROOT),
    ),
    "ProjectedGravity": Case(lambda r, **k: T.ProjectedGravity(r("out"), **k), "function", ROOT[1:]),
    "RandomPush": Case(lambda r, **k: T.RandomPush([2, 3], [1.0] * 3, [1.0] * 3, **k), "state", random=True),
    "ReferenceStateInitialization": Case(lazy("ReferenceStateInitialization"), "init", random=True),
    "RelativeJointPos": Case(
        lambda r, **k: T.RelativeJointPos(r("out"), default_joint_pos(), **k), "function", (("robot", "joint_pos"),)
    ),
    "ResidualAction": Case(lambda r, **k: T.ResidualAction(**k), "inverse", (("ref", "joint_pos"),)),
    "ResetNoiseCurriculum": Case(lambda r, **k: T.ResetNoiseCurriculum(20, **k), "init"),
    "Rewind": Case(lambda r, **k: T.Rewind(**k), "init", (("ref", "step"),), random=True),
    "RewardGroups": Case(
        lambda r, **k: T.RewardGroups({"near": ["one"]}, {r(("error", "one")): 2.0}, 0.02, **k),
        "reward",
        (("error", "one"),),
    ),
    "RewardRate": Case(lambda r, **k: T.RewardRate(0.02, **k), "reward"),
    "SpringAssist": Case(spring, "inverse", (("ref", "step"), *MOVING_ROOT)),
    "SurvivalReward": Case(lambda r, **k: T.SurvivalReward(**k), "reward"),
    "TrackedBodies": Case(
        lambda r, **k: T.TrackedBodies([".*_knee_link", "pelvis"], g1.BODY_NAMES, **k),
        "function",
        (*ROBOT_BODY, *ROOT),
    ),
    "TrackingReward": Case(
        lambda r, **k: T.TrackingReward("pose", 2.0, [r(e) for e in ERRORS], [0.5, 1.0], [0.0, 0.1], **k),
        "reward",
        ERRORS,
    ),
    "UniformNoise": Case(lambda r, **k: T.UniformNoise(r(X), 0.1, **k), "function", (X,), random=True),
    "VectorInRoot": Case(
        lambda r, **k: T.VectorInRoot(r(CONTACT[2]), r("out"), **k), "function", (CONTACT[2], ROOT[1])
    ),
}
BASES = {"RewardTerm", "TerminationTerm"}


def base(case: Case, **kwargs) -> ScriptedEnv:
    return ScriptedEnv(make_script(case.reads, N), **kwargs)


def env_of(name: str, **kwargs) -> TransformedEnv:
    return wrap(base(CASES[name], **kwargs), CASES[name].make())


def names(**wanted) -> list[str]:
    """Cases whose fields have the wanted values."""
    return [
        name
        for name, case in CASES.items()
        if all(getattr(case, k) in (v if isinstance(v, tuple) else (v,)) for k, v in wanted.items())
    ]


def entries(case: Case, batch: tuple[int, ...], seed: int = 1) -> TensorDict:
    """What a transform reads, of this batch."""
    count = torch.Size(batch).numel()
    script = make_script(case.reads, count, 1, seed)
    out = TensorDict({}, batch_size=batch)
    for key, table in script.items():
        out.set(key, table[0].reshape(*batch, *table.shape[2:]))
    return out


def transitions(case: Case, batch: tuple[int, ...]) -> TensorDict:
    """Recorded transitions with what a transform reads, now and next."""
    data = entries(case, batch)
    data.set("action", torch.randn(*batch, 4, generator=torch.Generator().manual_seed(0)))
    following = entries(case, batch, seed=2)
    for key in ("done", "terminated", "truncated"):
        following.set(key, torch.zeros(*batch, 1, dtype=torch.bool))
    following.set("reward", torch.ones(*batch, 1))
    data.set("next", following)
    return data


def test_every_transform_has_a_case():
    assert set(CASES) == set(T.__all__) - BASES


@pytest.mark.parametrize("name", CASES)
class TestEnvironments:
    def test_single(self, name):
        env = env_of(name)
        check_env_specs(env)
        assert env.rollout(4, break_when_any_done=False).shape == (N, 4)

    def test_serial(self, name):
        env = SerialEnv(2, partial(env_of, name))
        check_env_specs(env)
        assert env.rollout(3, break_when_any_done=False).shape == (2, N, 3)

    def test_compose(self, name):
        """The same with other transforms around it."""
        case = CASES[name]
        env = wrap(base(case), T.AbsoluteDifference("clock", "clock", "zero"), case.make(), T.Flatten("zero", "flat"))
        check_env_specs(env)

    def test_steps_and_resets_leave_their_input_alone(self, name):
        env = env_of(name, episode_steps=3)
        tensordict = env.reset()
        for t in range(4):
            tensordict.set(
                "action", torch.full((N, 4), float(t)) if name != "JointPositionAction" else torch.ones(N, 2)
            )
            before = tensordict.clone()
            stepped, following = env.step_and_maybe_reset(tensordict)
            assert_same(stepped.exclude("next").select(*before.keys(True, True)), before)
            tensordict = following

    def test_steps_do_not_overwrite_earlier_ones(self, name):
        env, kept = env_of(name), []
        tensordict = env.reset()
        for step in drive(env, 4, start=tensordict):
            kept.append((step, step.clone()))
        env.reset()
        drive(env, 2)
        for step, copied in kept:
            assert_same(step, copied)


# -- keys -------------------------------------------------------------------------------------------------------------

SHARED = ("action_key", "env_action_key", "reward_key", "terminated_key", "truncated_key", "done_key", "worlds_key")


def new(key: NestedKey) -> NestedKey:
    """Another name for a key, in one subtree with all others."""
    return unravel_key(("new", key))


def keywords(name: str, rename: Rename, leave: tuple[str, ...] = ()) -> dict[str, NestedKey]:
    """All keys of a transform that are keywords, renamed; those that follow from others get a name of their own."""
    parameters = inspect.signature(getattr(T, name).__init__).parameters.values()
    given = {p.name: p.default for p in parameters if p.name.endswith("_key") and p.default is not p.empty}
    own = {key: ("own", key) if value is None else value for key, value in given.items()}
    return {key: value if key in leave else rename(value) for key, value in own.items()}


def spelled(name: str, rename: Rename) -> tuple[TransformedEnv, list[TensorDict]]:
    """An environment whose every entry is renamed, under the transform with every key renamed; and three steps."""
    case, done_group = CASES[name], None if rename("done") == "done" else "new"
    script = {rename(key): value for key, value in make_script(case.reads, N).items()}
    env = ScriptedEnv(script, 4, None, True, rename("action"), rename("reward"), done_group)
    env = wrap(env, case.build(rename, **keywords(name, rename)))
    torch.manual_seed(0)
    start = env.reset()
    return env, [start.clone(), *drive(env, 3, start=start)]


def start_after_failures(env: TransformedEnv, rename: Rename) -> TensorDictBase:
    """What an environment is told to reset to when all its episodes have failed."""
    out = TensorDict({}, batch_size=[N])
    out.set(rename("terminated"), torch.ones(N, 1, dtype=torch.bool))
    out.set(rename(("ref", "step")), torch.tensor([[30], [130], [230]]))
    torch.manual_seed(0)
    return env.transform._reset_env_preprocess(out)


@pytest.mark.parametrize("name", CASES)
def test_every_key_is_an_argument(name):
    """With other names for all entries nothing changes but the names, and no entry has a name of ours."""
    env, steps = spelled(name, lambda key: key)
    other, renamed_steps = spelled(name, new)
    for step, renamed in zip(steps, renamed_steps, strict=True):
        for part in ("next", None):
            ours, theirs = (td if part is None else td.get(part, None) for td in (step, renamed))
            if ours is None:
                continue
            ours, theirs = ours.exclude("next"), theirs.exclude("next")
            assert {key[0] for key in theirs.keys(True, True)} == {"new"}
            assert_same(theirs["new"], ours)
    if CASES[name].kind == "init":
        ours, theirs = start_after_failures(env, lambda key: key), start_after_failures(other, new)
        assert not ours["init"].is_empty()
        assert set(theirs.keys()) == {"new"}
        assert_same(theirs["new"], ours)
    check_env_specs(other)


# A target per joint becomes one per physics step, and few joints' become all joints': once.
ONCE = ("ActionDelay", "JointPositionAction")


@pytest.mark.parametrize("name", [name for name in CASES if name not in ONCE])
def test_two_of_a_kind_share_nothing(name):
    """One over ours and one over renamed entries, in one stack: each does what it does alone."""
    case = CASES[name]
    script = make_script(case.reads, N)
    both = script | {new(key): value for key, value in script.items()}
    second = (
        case.build(new, **keywords(name, new, SHARED))
        if name != "ActionHistory"
        else T.ActionHistory(3, action_key="action", out_key=("new", "action_history"))
    )
    env = wrap(ScriptedEnv(both), case.make(), second)
    check_env_specs(env)
    alone = drive(env_of(name), 4)
    together = drive(env, 4)
    kept = set(alone[-1].keys(True, True)) - {"reward", ("next", "reward")}
    written = {key for key in kept if key in together[-1].keys(True, True)}
    assert written == kept
    if case.random or case.kind == "inverse":
        return
    for a, b in zip(alone, together, strict=True):
        assert_same(b.select(*kept), a.select(*kept))
        ours = [key for key in case.make().out_keys if key in a["next"].keys(True, True)]
        for key in ours if case.kind == "function" else ():
            assert torch.equal(b["next"].get(new(key)), a["next"].get(key))


@pytest.mark.parametrize("name", [name for name in names(kind="state") if name != "MotionEnd"])
def test_state_of_another_is_refused(name):
    with pytest.raises(ValueError, match=f"{name}: its state would be kept at .* give it another key"):
        wrap(base(CASES[name]), CASES[name].make(), CASES[name].make()).full_observation_spec  # noqa: B018


def test_states_of_entries_with_one_last_name():
    """Two histories of entries that end alike, as policy and critic may have."""
    script = {("policy", "x"): constant([1.0], N, 4), ("critic", "x"): constant([2.0], N, 4)}
    env = wrap(ScriptedEnv(script), T.History(("policy", "x"), 1), T.History(("critic", "x"), 1))
    step = drive(env, 1)[0]["next"]
    assert step["policy", "x"][0].tolist() == [1.0, 1.0]
    assert step["critic", "x"][0].tolist() == [2.0, 2.0]


@pytest.mark.parametrize("name", [name for name in CASES if name != "Concatenate"])  # TorchRL's CatTensors, which edits
def test_specs_that_are_given_are_left_alone(name):
    env, transform = base(CASES[name]), CASES[name].make()
    around = wrap(env, transform)
    specs = {
        "output": env.output_spec.clone(),
        "input": env.input_spec.clone(),
        "observation": env.full_observation_spec.clone(),
        "reward": env.full_reward_spec.clone(),
        "done": env.full_done_spec.clone(),
    }
    for part, spec in specs.items():
        before = spec.clone()
        getattr(transform, f"transform_{part}_spec")(spec)
        assert spec == before
    around.full_observation_spec  # noqa: B018
    assert env.output_spec == specs["output"]
    assert env.input_spec == specs["input"]


# -- batches of environments ------------------------------------------------------------------------------------------

# What the environment must read besides its own keys, or in another shape, does not pass through a batch of
# environments: these stand next to the base environment.
NEXT_TO_THE_BASE = {
    "ActionDelay",
    "RandomPush",
    "SpringAssist",
    *(name for name in CASES if CASES[name].kind == "init"),
}


@pytest.mark.parametrize("name", [name for name in CASES if name not in NEXT_TO_THE_BASE])
def test_trans_of_serial(name):
    """Above a batch of environments there are two batch dimensions; each row comes out as with one."""
    case = CASES[name]
    env = wrap(SerialEnv(2, partial(wrap_nothing, name)), case.make())
    check_env_specs(env)
    above = torch.stack(drive(env, 3), -1)
    assert above.shape == (2, N, 3)
    if case.random:
        return
    alone = drive(env_of(name), 3, lambda t: above["action"][0, :, t])
    for t, step in enumerate(alone):
        assert_same(above[0, :, t], step)


def wrap_nothing(name: str) -> ScriptedEnv:
    return base(CASES[name])


REPRESENTATIVE = Case(Compose, "state", (X, Y, ("error", "many"), *CONTACT, ("robot", "foot_force")))


def lower() -> list[Transform]:
    """Transforms with state, one of each kind, for the workers of a parallel environment."""
    return [
        T.FeetState(0.02, force_threshold=1.5),
        T.EpisodeNoise(Y, 0.1),
        T.ErrorTermination("error", [("error", "many")], [1.5], min_steps=2),
        T.ActionSmoothing(alpha=(0.5, 0.5), size=4),
    ]


def upper() -> list[Transform]:
    """Transforms of each kind for above a parallel environment."""
    return [
        T.ContactMade(),
        T.History(X, 2),
        T.LostContact(min_force=2.0, min_steps=2),
        T.InteractionReward(),
        T.JointPositionAction({".*": 1.0}, JOINTS),
        T.ActionHistory(2, 4),
    ]


def lower_env() -> TransformedEnv:
    return wrap(base(REPRESENTATIVE), *lower())


def test_parallel():
    """In worker processes and above them, state in the tensordict survives the way there and back."""
    env = wrap(ParallelEnv(2, lower_env), *upper())
    try:
        check_env_specs(env)
        got = torch.stack(drive(env, 5), -1)
    finally:
        env.close()
    assert got.shape == (2, N, 5)
    alone = drive(wrap(base(REPRESENTATIVE), *lower(), *upper()), 5, lambda t: got["action"][1, :, t])
    drawn = [Y, ("episode_noise", "obs", "y")]
    drawn += [("next", *key) for key in drawn]
    for t, step in enumerate(alone):
        # action transforms note what they did in what their environment is given
        assert_same(got[1, :, t].exclude(*drawn), step.select(*got.keys(True, True)).exclude(*drawn))


class TestWithoutAnEnvironment:
    @pytest.mark.parametrize("batch", [(N,), (2, N), ()], ids=str)
    @pytest.mark.parametrize("name", names(kind="function"))
    def test_function(self, name, batch):
        """On data alone, of any batch, each row comes out as with one batch dimension."""
        case = CASES[name]
        transform, data = case.make(), entries(case, batch)
        flat = transform(data.clone().reshape(-1))
        out = transform(data.clone())
        for key in transform.out_keys:
            assert out.get(key).shape[: len(batch)] == batch
            if not case.random:
                torch.testing.assert_close(out.get(key).reshape(flat.get(key).shape), flat.get(key))

    @pytest.mark.parametrize("batch", [(N,), (2, N), ()], ids=str)
    def test_errors_of_a_single_pose(self, batch):
        """One pose per world gives one error per world, whatever the batch."""
        case = Case(Compose, "function", (("robot", "root_pos"), ("robot", "root_quat")))
        data = entries(case, batch)
        root_pos, root_quat = case.reads
        T.Distance(root_pos, root_pos, "distance")(data)
        T.Angle(root_quat, root_quat, "angle")(data)
        assert data["distance"].shape == data["angle"].shape == (*batch, 1)

    @pytest.mark.parametrize("name", names(kind="function"))
    def test_model(self, name):
        """As a layer of a module."""
        case = CASES[name]
        transform = case.make()
        data = entries(case, (N,))
        torch.manual_seed(0)
        out = nn.Sequential(transform)(data.clone())
        torch.manual_seed(0)
        assert_same(out, transform(data.clone()))
        assert set(transform.out_keys) <= set(out.keys(True, True))

    @pytest.mark.parametrize("name", names(kind="state"))
    def test_stateful_ones_say_no(self, name):
        case = CASES[name]
        with pytest.raises(NotImplementedError, match=name):
            case.make()(entries(case, (N,)))

    @pytest.mark.parametrize("name", names(kind=("inverse", "init")))
    def test_nothing_to_do(self, name):
        """Those that only act on the way in, or on resets, pass data on as it is."""
        case = CASES[name]
        data = entries(case, (N,))
        assert_same(case.make()(data.clone()), data)


class TestReplayBuffer:
    @staticmethod
    def buffer(transform: Transform) -> TensorDictReplayBuffer:
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=6)
        buffer.append_transform(transform)
        return buffer

    @pytest.mark.parametrize("name", names(kind=("function", "reward")))
    def test_sample(self, name):
        """Sampled data is transformed, stored data is not."""
        case = CASES[name]
        transform, data = case.make(), transitions(case, (10,))
        buffer = self.buffer(transform)
        buffer.extend(data)
        prefix = ("next",) if case.kind == "reward" else ()
        for _ in range(2):
            sample = buffer.sample()
            for key in transform.out_keys:
                assert sample.get((*prefix, *([key] if isinstance(key, str) else key))).shape[0] == 6
            if isinstance(transform, T.RewardTerm):
                term = sample.get(("next", *transform.out_keys[0]))
                torch.testing.assert_close(sample["next", "reward"], 1 + transform.weight * term)
            if isinstance(transform, T.RewardRate):
                torch.testing.assert_close(sample["next", "reward"], torch.full((6, 1), 0.02))

    @pytest.mark.parametrize("name", names(kind="reward"))
    def test_reward_of_time_batches(self, name):
        """Recorded trajectories [B, T] give what the environment gave."""
        case = CASES[name]
        transform = case.make()
        env = wrap(base(case), transform)
        recorded = env.rollout(4)
        stripped = recorded.clone()
        stripped["next", "reward"] = torch.zeros_like(stripped["next", "reward"])
        again = case.make()(stripped.exclude(("next", "reward_terms")))
        torch.testing.assert_close(again["next", "reward"], recorded["next", "reward"])
        key = ("next", *transform.out_keys[0])
        torch.testing.assert_close(again.get(key), recorded.get(key))

    @pytest.mark.parametrize("name", names(kind="inverse"))
    def test_inverse_on_the_way_in(self, name):
        case = CASES[name]
        width = 2 if name == "JointPositionAction" else 4
        data = transitions(case, (10,)).set("action", torch.ones(10, width))
        buffer = self.buffer(case.make())
        buffer.extend(data)
        torch.testing.assert_close(buffer[:]["action"], case.make().inv(data)["action"])


class TestInverse:
    ones = torch.ones(N, 4)

    @pytest.mark.parametrize("name", names(kind="inverse"))
    def test_action_reaches_the_environment_transformed(self, name):
        env = env_of(name)
        tensordict = env.reset()
        action = torch.arange(1.0, 7).reshape(N, 2) if name == "JointPositionAction" else self.ones
        out = env.step(tensordict.set("action", action))
        expected = {
            "JointPositionAction": torch.tensor([[0.5, 0, 1, 0], [1.5, 0, 2, 0], [2.5, 0, 3, 0]]),
            "DefaultPoseAction": torch.tensor([1.1, 1.2, 1.3, 1.4]).expand(N, 4),
            "SpringAssist": self.ones,
            "ResidualAction": 1 + env.base_env.script[("ref", "joint_pos")][0] if name == "ResidualAction" else None,
        }[name]
        torch.testing.assert_close(env.base_env.received, expected)
        # the action in the data stays the policy's
        torch.testing.assert_close(out["action"], action)
        assert env.action_spec.shape == action.shape

    def test_reads_of_what_nobody_writes_are_refused(self):
        env = wrap(ScriptedEnv(make_script([X])), T.ResidualAction(("nobody", "writes")))
        with pytest.raises(KeyError, match=r"ResidualAction.*nobody"):
            env.input_spec  # noqa: B018

    def test_function_of_what_nobody_writes_is_refused(self):
        env = wrap(ScriptedEnv(make_script([X])), T.Flatten(("nobody", "writes"), "out"))
        with pytest.raises(KeyError, match=r"Flatten.*nobody"):
            env.output_spec  # noqa: B018


class TestPartialReset:
    mask = torch.tensor([True, False, True])

    def reset(self, env: TransformedEnv, tensordict: TensorDictBase) -> TensorDictBase:
        return env.reset(tensordict.set("_reset", self.mask.clone()))

    @pytest.mark.parametrize("name", CASES)
    def test_only_masked_rows_change(self, name):
        env = env_of(name)
        fresh = env.reset()
        last = env.step_mdp(drive(env, 3, start=fresh.clone())[-1])
        before = last.clone()
        after = self.reset(env, last).exclude("_reset", "reward", "init")
        shared = [key for key in fresh.keys(True, True) if key in after.keys(True, True)]
        assert set(env.full_state_spec.keys(True, True)) <= set(after.keys(True, True))
        assert_same(after.select(*shared), before.select(*shared), ~self.mask)
        if not CASES[name].random:
            assert_same(after.select(*shared), fresh.select(*shared), self.mask)

    @pytest.mark.parametrize("name", [name for name in CASES if not CASES[name].random])
    def test_other_rows_continue_as_if_nothing_had_happened(self, name):
        env = env_of(name)
        whole = drive(env, 6)
        first = drive(env, 3)
        resumed = self.reset(env, env.step_mdp(first[-1])).exclude("_reset")
        actions = iter([step["action"] for step in whole[3:]])
        second = drive(env, 3, lambda _: next(actions), start=resumed)
        for a, b in zip(second, whole[3:], strict=True):
            a, b = (td.exclude("done", "terminated", "truncated", "completed") for td in (a, b))
            assert_same(a["next"], b["next"], ~self.mask)
        # and the reset ones start over
        actions = iter([step["action"] for step in whole[3:]])
        restart = drive(env, 3, lambda _: next(actions))
        for a, b in zip(second, restart, strict=True):
            assert_same(a["next"], b["next"], self.mask)

    @pytest.mark.parametrize("name", names(kind="state", random=True))
    def test_draws_of_other_rows_stay(self, name):
        """What is drawn per episode is drawn anew for the reset rows only."""
        drawn = {
            "ActionDelay": ("delay", "action", "substeps"),
            "ActionSmoothing": ("smoothing", "action", "alpha"),
            "EpisodeNoise": ("episode_noise", "obs", "x"),
            "JointOffset": ("joint_offset", "action"),
        }
        if name not in drawn:
            pytest.skip("draws in every step")
        env = env_of(name)
        torch.manual_seed(0)
        td = env.reset()
        start = td.get(drawn[name]).clone()
        last = drive(env, 3, start=td)[-1]
        torch.testing.assert_close(last["next"].get(drawn[name]), start)
        changed = torch.zeros(N, dtype=torch.bool)
        for _ in range(8):
            after = self.reset(env, env.step_mdp(last)).get(drawn[name])
            changed |= (after != start).any(-1)
        assert changed.tolist() == self.mask.tolist()


class TestDone:
    @pytest.mark.parametrize("name", names(ends=True))
    def test_what_ends_an_episode_also_resets_it(self, name):
        env = env_of(name)
        tensordict, ended = env.reset(), torch.zeros(N, dtype=torch.bool)
        state = [k for k in env.full_state_spec.keys(True, True) if k not in env.action_keys]
        fresh = tensordict.clone()
        for _ in range(10):
            tensordict.set("action", torch.zeros(N, 4))
            stepped, tensordict = env.step_and_maybe_reset(tensordict)
            following = stepped["next"]
            done = following["done"].squeeze(-1)
            assert torch.equal(following["done"], following["terminated"] | following["truncated"])
            ended |= done
            assert not tensordict["done"].any()
            # the reset took place: clock and counts of the rows that ended start over, others move on
            assert torch.equal(tensordict["clock"] == 0, done.unsqueeze(-1))
            for key in state:
                assert torch.equal(tensordict.get(key)[done], fresh.get(key)[done])
        assert ended.any()

    def test_termination_of_the_environment_is_kept(self):
        """A condition that does not hold takes nothing back."""
        script = make_script([("error", "one")])
        script[("error", "one")] = script[("error", "one")] * 0
        env = wrap(ScriptedEnv(script, episode_steps=2), T.ErrorTermination("e", [("error", "one")], [1.0]))
        steps = drive(env, 2)
        assert [bool(s["next", "terminated"].all()) for s in steps] == [False, True]
        assert [bool(s["next", "done"].all()) for s in steps] == [False, True]


@pytest.mark.parametrize("name", CASES)
def test_state_dict_round_trip(name):
    env, other = env_of(name), env_of(name)
    for each in (env, other):
        each.rollout(2)
    drive(env, 6)
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    assert_same(TensorDict(env.state_dict()), TensorDict(other.state_dict()))
    rollouts = []
    for each in (env, other):
        torch.manual_seed(1)
        rollouts.append(torch.stack(drive(each, 3), -1))
    assert_same(*rollouts)


def test_failures_travel_with_the_state_dict():
    a, b = (CASES["AdaptiveStateInitialization"].make() for _ in range(2))
    a.failures[3] = 2.0
    b.load_state_dict(a.state_dict())
    assert b.failures[3] == 2.0


class TestCompiled:
    """A graph of the whole function, without breaks, gives what eager mode gives."""

    @pytest.mark.parametrize("name", ["TrackedBodies", "ContactPoints", "PoseInRoot"])
    def test_function(self, name):
        case = CASES[name]
        transform = case.make()
        inputs = [entries(case, (N,)).get(key) for key in transform.in_keys]
        eager = transform.function(*inputs)
        compiled = torch.compile(transform.function, backend="aot_eager", fullgraph=True)(*inputs)
        torch.testing.assert_close(compiled, eager)

    def test_stack(self):
        """Steps of rewards and terminations in one Compose."""
        transform = Compose(
            T.ContactMade(),
            T.LostContact(min_steps=1),
            T.InteractionReward(),
        )
        case = Case(lambda: transform, "state", CONTACT)
        data = transitions(case, (N,)).set(("termination_steps", "lost_contact"), torch.zeros(N, 1, dtype=torch.int64))

        def step(data: TensorDictBase) -> TensorDictBase:
            return transform._step(data, data["next"].copy())

        eager = step(data.clone())
        compiled = torch.compile(step, backend="eager", fullgraph=True)(data.clone())
        torch.testing.assert_close(compiled.to_dict(), eager.to_dict())
        assert eager["terminated"].any()
