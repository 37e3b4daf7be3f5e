"""Order that carries meaning: what has to stand before what in the transform stack, and why.

Steps go through the stack from its first transform to its last, actions and what is drawn before a reset from the last
to the first. Most orders give some environment; those that would give another one than their config says are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tensordict import NestedKey, unravel_key
from torchrl.envs import EnvBase, RewardSum, StepCounter, Transform

from hdmi.config import ConfigError
from hdmi.transforms import (
    ActionDelay,
    ActionSmoothing,
    AdaptiveStateInitialization,
    DefaultPoseAction,
    EpisodeNoise,
    HeadingNoise,
    History,
    JointOffset,
    JointPositionAction,
    MotionEnd,
    ObjectScale,
    ReferenceStateInitialization,
    ResetNoiseCurriculum,
    ResidualAction,
    RewardGroups,
    RewardRate,
    RewardTerm,
    Rewind,
    TerminationTerm,
    UniformNoise,
)
from hdmi.transforms.common import StateTransform
from hdmi.transforms.randomization import ModelRandomization

Stack = Sequence[tuple[str, Transform]]  # nodes and transforms, from the base environment outwards
Rule = Callable[[Stack], str | None]  # what is wrong with a stack, if anything
Kind = Callable[[Transform], bool]


def _is(*classes: type) -> Kind:
    return lambda transform: isinstance(transform, classes)


def _always(first: Transform, then: Transform) -> bool:
    return True


def _named(node: str, transform: Transform) -> str:
    return f"{node} ({type(transform).__name__})"


@dataclass(frozen=True)
class Before:
    """A rule: transforms of one kind stand before those of another.

    Args:
        first, then: the two kinds.
        why: what another order would do.
        related: which pairs of them are meant; all by default.
    """

    first: Kind
    then: Kind
    why: str
    related: Callable[[Transform, Transform], bool] = _always

    def __call__(self, stack: Stack) -> str | None:
        for i, (node, transform) in enumerate(stack):
            for other, later in stack[i + 1 :] if self.then(transform) else ():
                if self.first(later) and self.related(later, transform):
                    return f"{_named(other, later)} has to stand before {_named(node, transform)}: {self.why}"
        return None


def listed_keys(transform: Transform, name: str) -> list[NestedKey] | None:
    """One of a transform's lists of keys; None for those of TorchRL's that find their keys in an environment only."""
    try:
        return getattr(transform, name)
    except (AttributeError, NotImplementedError):
        return None


def read_keys(transform: Transform) -> list[NestedKey]:
    """What a transform reads of a step or a reset that comes from the environment, as far as it says so."""
    return [
        unravel_key(key) for key in (*(listed_keys(transform, "in_keys") or ()), *getattr(transform, "state_keys", ()))
    ]


def written_keys(transform: Transform) -> set[NestedKey]:
    """What a transform adds to a step or a reset, as far as it says so."""
    keys = [*(listed_keys(transform, "out_keys") or ()), *(listed_keys(transform, "out_keys_inv") or ())]
    if isinstance(transform, StateTransform):
        keys += transform.own_keys
    if isinstance(transform, StepCounter):
        keys.append(transform.step_count_key)
    return {unravel_key(key) for key in keys}


# -- kinds ------------------------------------------------------------------------------------------------------------

_NOISE = _is(UniformNoise, EpisodeNoise, HeadingNoise)
_TARGET = _is(ResidualAction, DefaultPoseAction)


def _drawn_per(when: str) -> Kind:
    return lambda transform: isinstance(transform, ModelRandomization) and transform.per == when


def _model_fields(transform: Transform) -> set[str]:
    """Fields of the model that a randomization draws."""
    return {name for name, _ in transform.named_buffers() if name.startswith("nominal_")}


def _same_field(first: Transform, then: Transform) -> bool:
    return bool(_model_fields(first) & _model_fields(then))


def _same_key(first: Transform, then: Transform) -> bool:
    return read_keys(first)[:1] == read_keys(then)[:1]


def _reads_terminated(transform: Transform) -> bool:
    return isinstance(transform, MotionEnd) or (isinstance(transform, RewardTerm) and "terminated" in transform.in_keys)


# -- rules ------------------------------------------------------------------------------------------------------------


def _noise_is_seen(stack: Stack) -> str | None:
    """Noise or history on an entry that has been read for the last time changes nothing."""
    for i, (node, transform) in enumerate(stack):
        if not _NOISE(transform) and not isinstance(transform, History):
            continue
        key = read_keys(transform)[0]
        others = [j for j, (_, other) in enumerate(stack) if key in read_keys(other) and key not in written_keys(other)]
        if others and max(others) < i:
            reader = _named(*stack[max(others)])
            return f"{_named(node, transform)} has to stand before {reader}: nothing after it reads {key!r}"
    return None


def _failures_have_a_frame(stack: Stack) -> str | None:
    """Adaptive starts count failures by the frame of the motion clock."""
    clock = ("ref", "step")
    for node, transform in stack:
        if isinstance(transform, AdaptiveStateInitialization) and not any(clock in written_keys(t) for _, t in stack):
            return f"{_named(node, transform)} counts failures by {clock!r}, which nothing in the stack writes"
    return None


RULES: tuple[Rule, ...] = (
    # what is drawn before a reset goes from last to first
    Before(
        _is(ReferenceStateInitialization),
        _is(ObjectScale),
        "resets go through the stack from last to first, and starts have to know the size that is drawn",
    ),
    Before(
        _is(ReferenceStateInitialization),
        _is(Rewind),
        "resets go through the stack from last to first, and starts have to know the frame that is chosen",
    ),
    Before(
        _is(ReferenceStateInitialization),
        _is(ResetNoiseCurriculum),
        "resets go through the stack from last to first, and starts have to know how much they are perturbed",
    ),
    Before(
        _drawn_per("episode"),
        _drawn_per("world"),
        "resets go through the stack from last to first, and what is drawn per world has to find an untouched model",
        _same_field,
    ),
    _failures_have_a_frame,
    # actions, too
    Before(_is(ActionDelay), _is(ActionSmoothing), "the delay is the last thing that happens to a target"),
    Before(_is(ActionDelay), _TARGET, "it is targets that are delayed, not the policy's offsets from them"),
    Before(_is(ActionSmoothing), _TARGET, "it is targets that are smoothed, not the policy's offsets from them"),
    Before(
        _is(ActionDelay, ActionSmoothing, ResidualAction, DefaultPoseAction, JointOffset),
        _is(JointPositionAction),
        "actions go through the stack from last to first, and this one makes joint angles of them",
    ),
    # steps
    Before(_is(TerminationTerm), _reads_terminated, "it reads `terminated`, which would not be complete"),
    Before(_is(RewardTerm), _is(RewardRate), "a term after it would count for as much as a second of the others"),
    Before(_is(RewardTerm), _is(RewardGroups), "a term after it would be in no group"),
    Before(_is(RewardTerm, RewardRate), _is(RewardSum), "the return would be another than that of the reward"),
    Before(_NOISE, _is(History), "past observations would be perturbed anew in every step", _same_key),
    _noise_is_seen,
)


def check_order(stack: Stack) -> None:
    """Checks a stack against all rules.

    Raises:
        ConfigError: for the first one that it breaks; names both nodes and the order that would be right.
    """
    for rule in RULES:
        if (message := rule(stack)) is not None:
            raise ConfigError(f"stack: {message}")


def check_reads(stack: Stack, base: EnvBase) -> None:
    """Checks that what each transform reads is there by then, from the base environment or a transform before it.

    Behind a transform that does not say what it writes, only what comes too late is known.

    Raises:
        ConfigError: for the first that is not; names the reader, and who writes it too late.
    """
    spec = base.output_spec
    groups = ("full_observation_spec", "full_reward_spec", "full_done_spec")
    there = {unravel_key(key) for group in groups for key in spec[group].keys(True, True)}
    all_known = True
    for i, (node, transform) in enumerate(stack):
        for key in read_keys(transform):
            if key in there:
                continue
            late = [_named(*item) for item in stack[i + 1 :] if key in written_keys(item[1])]
            reads = f"{_named(node, transform)} reads {key!r}, which"
            if late:
                raise ConfigError(f"stack: {reads} {late[0]} writes only after it: {late[0]} has to stand before")
            if all_known:
                raise ConfigError(f"stack: {reads} nothing before it writes")
        there |= written_keys(transform)
        all_known &= listed_keys(transform, "out_keys") is not None
