"""The transforms on an environment that is not ours, with its own names, mapped by arguments only."""

from __future__ import annotations

import math

import pytest
import torch
from mocks import ScriptedEnv, constant, drive, wrap
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from hdmi.transforms import ErrorTermination, History, InteractionReward, MotionEnd, ResidualAction, UniformNoise

E1 = math.exp(-1)


class GripperEnv(EnvBase):
    """A point gripper on a rail that drives to a button. N worlds; nothing in it is a humanoid.

    Command: ("motor", "command") [N, 1], the gripper's next position, m. The button stands at 1 m and is felt as a
    force of 100 N for each metre that the gripper is beyond 0.9 m. The reward is the gripper's position.
    """

    batch_locked = True

    def __init__(self, num_envs: int = 2, length: int = 6):
        super().__init__(batch_size=[num_envs])
        n, self.length = num_envs, length
        self.position, self.clock = torch.zeros(n, 1), torch.zeros(n, 1, dtype=torch.int64)

        def real(*shape: int) -> Unbounded:
            return Unbounded(shape=(n, *shape))

        self.observation_spec = Composite(
            {
                "obs_hand": real(1, 3),
                "obs_button": real(1, 3),
                ("sensors", "touch"): real(1, 3),
                ("plan", "press"): Binary(n=1, shape=(n, 1), dtype=torch.bool),
                ("plan", "position"): real(1),
                "miss": real(1),
            },
            shape=(n,),
        )
        self.full_action_spec = Composite({("motor", "command"): real(1)}, shape=(n,))
        self.full_reward_spec = Composite({("score", "value"): real(1)}, shape=(n,))
        self.full_done_spec = Composite(
            {key: Binary(n=1, shape=(n, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")},
            shape=(n,),
        )

    def _observe(self) -> TensorDict:
        def along(x: Tensor) -> Tensor:
            return torch.cat([x, torch.zeros_like(x), torch.zeros_like(x)], -1).unsqueeze(1)

        plan = 0.25 * self.clock.float()
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {
                "obs_hand": along(self.position),
                "obs_button": along(torch.ones_like(self.position)),
                "sensors": {"touch": along(100 * (self.position - 0.9).clamp(min=0))},
                "plan": {"press": self.clock >= 2, "position": plan},
                "miss": (self.position - plan).abs(),
                "done": no,
                "terminated": no.clone(),
                "truncated": no.clone(),
            },
            batch_size=self.batch_size,
        )

    def _step(self, tensordict):
        self.position, self.clock = tensordict["motor", "command"].clone(), self.clock + 1
        return self._observe().set(("score", "value"), self.position.clone())

    def _reset(self, tensordict=None, **kwargs):
        mask = torch.ones(self.batch_size, dtype=torch.bool) if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(*self.batch_size, 1, dtype=torch.bool) if mask is None else mask.reshape(-1, 1)
        self.position, self.clock = self.position.masked_fill(mask, 0.0), self.clock.masked_fill(mask, 0)
        return self._observe()

    def _set_seed(self, seed):
        pass


def gripper(*more) -> TransformedEnv:
    return wrap(
        GripperEnv(),
        ResidualAction(base_key=("plan", "position"), action_key=("motor", "command")),
        InteractionReward(
            "press",
            weight=2.0,
            sigma_pos=0.5,
            sigma_frc=20.0,
            force_threshold=10.0,
            eef_pos_key="obs_hand",
            target_pos_key="obs_button",
            force_key=("sensors", "touch"),
            active_key=("plan", "press"),
            reward_key=("score", "value"),
        ),
        ErrorTermination("off_plan", ["miss"], [0.4], min_steps=2),
        *more,
    )


def command(value: float):
    return lambda _: torch.full((2, 1), value)


def test_specs():
    env = gripper()
    check_env_specs(env)
    assert env.action_key == ("motor", "command")
    assert env.rollout(4, break_when_any_done=False).shape == (2, 4)


def test_residual_action_and_interaction_reward():
    """Command 0.25 beyond the plan of the present step: the gripper is where the plan is a step later, no miss."""
    steps = drive(gripper(), 4, command(0.25))
    position = [0.25, 0.5, 0.75, 1.0]
    for t, step in enumerate(steps):
        following = step["next"]
        torch.testing.assert_close(following["obs_hand"][:, 0, 0], torch.full((2,), position[t]))
        touch = max(100 * (position[t] - 0.9), 0.0)
        expected = math.exp(-(1 - position[t]) / 0.5) * math.exp(min(touch - 10, 0) / 20)
        expected *= t + 1 >= 2  # pressing is intended from step 2 on
        term = torch.full((2, 1), expected)
        torch.testing.assert_close(following["reward_terms", "press"], term)
        torch.testing.assert_close(following["score", "value"], position[t] + 2 * term)
        assert not following["done"].any()
    # on the button with 10 N: the full reward
    torch.testing.assert_close(steps[-1]["next", "reward_terms", "press"], torch.ones(2, 1))


def test_termination_resets_the_environment():
    """0.5 m off the plan from the first step; the second in a row ends the episode."""
    env = gripper()
    tensordict, done = env.reset(), []
    for _ in range(4):
        tensordict.set(("motor", "command"), torch.tensor([[0.75], [0.25]]))
        step, tensordict = env.step_and_maybe_reset(tensordict)
        done.append(step["next", "done"].flatten().tolist())
        assert torch.equal(step["next", "terminated"], step["next", "termination", "off_plan"])
    assert done == [[False, False], [True, False], [False, False], [True, False]]
    torch.testing.assert_close(tensordict["obs_hand"][:, 0, 0], torch.tensor([0.0, 1.0]))


def test_with_torchrls_own():
    """Noise and history on its observations, and TorchRL's episode sums over the changed reward."""
    env = gripper(
        UniformNoise("miss", 0.0), History("miss", 2), RewardSum(in_keys=[("score", "value")], out_keys=["total"])
    )
    check_env_specs(env)
    steps = drive(env, 4, command(0.25))
    values = torch.stack([s["next", "score", "value"] for s in steps])
    torch.testing.assert_close(steps[-1]["next", "total"], values.sum(0))
    assert steps[-1]["next", "miss"].shape == (2, 3)


def test_environment_without_truncation():
    """Many environments have no `truncated`; an end of the motion brings it."""
    clock = torch.arange(5).reshape(-1, 1, 1)
    motion = type("Motion", (), {"num_frames": 3})
    env = wrap(ScriptedEnv({"t": clock}, truncates=False), MotionEnd(motion, step_key="t"))
    check_env_specs(env)
    steps = drive(env, 3)
    assert [bool(s["next", "truncated"]) for s in steps] == [False, True, True]
    assert [bool(s["next", "done"]) for s in steps] == [False, True, True]


def test_gymnasium():
    """A pendulum that is rewarded for where it is and ended when it spins, through TorchRL's wrapper."""
    pytest.importorskip("gymnasium")
    from torchrl.envs import GymEnv, SerialEnv

    def make():
        return GymEnv("Pendulum-v1")

    env = wrap(SerialEnv(2, make), ErrorTermination("spin", ["observation"], [1.5], min_steps=1))
    check_env_specs(env)
    env.rollout(3)


def test_names_of_configs_are_keys_too():
    """Lists, as they come from YAML, name nested keys."""
    env = wrap(
        ScriptedEnv({("a", "error"): constant([2.0], 2)}), ErrorTermination("e", [["a", "error"]], [1.0], min_steps=1)
    )
    assert drive(env, 1)[0]["next", "terminated"].all()
