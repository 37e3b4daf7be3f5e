"""TorchRL transforms for co-tracking a robot-and-object reference: each reads and writes keys, none knows another.

Most of them take a TensorDict; those that carry state work in an environment only.

Examples:
    What the classes' examples go on from.

    >>> from torchrl.envs import Compose, TransformedEnv
    >>> from hdmi.assets import RobotConfig, SimConfig, build_scene, g1
    >>> from hdmi.envs import HumanoidObjectEnv
    >>> from hdmi.motion import find_motion, make_reference
    >>> scene = build_scene(RobotConfig(), SimConfig())
    >>> base = HumanoidObjectEnv(scene, num_envs=2)
    >>> reference = make_reference(find_motion("walk"), control_dt=0.02)  # 550 frames
"""

from hdmi.transforms.action import (
    ActionDelay,
    ActionHistory,
    ActionSmoothing,
    DefaultPoseAction,
    JointPositionAction,
    ResidualAction,
)
from hdmi.transforms.assist import SpringAssist
from hdmi.transforms.concatenate import Concatenate
from hdmi.transforms.feedforward import FeedForwardTarget
from hdmi.transforms.observation import (
    Difference,
    EpisodeNoise,
    Flatten,
    HeadingNoise,
    History,
    PointInRoot,
    PoseInRoot,
    ProjectedGravity,
    RelativeJointPos,
    UniformNoise,
    VectorInRoot,
)
from hdmi.transforms.randomization import (
    CenterOfMassRandomization,
    FrictionRandomization,
    JointOffset,
    MassRandomization,
    ObjectJointRandomization,
    ObjectScale,
    RandomPush,
)
from hdmi.transforms.reference import (
    AdaptiveStateInitialization,
    MotionEnd,
    MotionReference,
    ReferenceStateInitialization,
    ResetNoiseCurriculum,
    Rewind,
)
from hdmi.transforms.reward import (
    ActionRateL2,
    FeetAirTime,
    FeetImpactL2,
    FeetSlip,
    FeetStumble,
    InteractionReward,
    JointPosLimitsL1,
    JointTorqueLimitsL1,
    JointVelL2,
    KernelReward,
    RewardGroups,
    RewardRate,
    RewardTerm,
    SurvivalReward,
    TrackingReward,
)
from hdmi.transforms.termination import (
    BodyHeight,
    ErrorTermination,
    KernelTermination,
    LostContact,
    TerminationTerm,
)
from hdmi.transforms.tracking import (
    AbsoluteDifference,
    Angle,
    BodyHeightError,
    ContactMade,
    ContactPoints,
    Distance,
    FeetState,
    JointErrors,
    Metrics,
    TrackedBodies,
)

__all__ = [
    "AbsoluteDifference",
    "ActionDelay",
    "ActionHistory",
    "ActionRateL2",
    "ActionSmoothing",
    "AdaptiveStateInitialization",
    "Angle",
    "BodyHeight",
    "BodyHeightError",
    "CenterOfMassRandomization",
    "Concatenate",
    "ContactMade",
    "ContactPoints",
    "DefaultPoseAction",
    "Difference",
    "Distance",
    "EpisodeNoise",
    "ErrorTermination",
    "FeedForwardTarget",
    "FeetAirTime",
    "FeetImpactL2",
    "FeetSlip",
    "FeetState",
    "FeetStumble",
    "Flatten",
    "FrictionRandomization",
    "HeadingNoise",
    "History",
    "InteractionReward",
    "JointErrors",
    "JointOffset",
    "JointPosLimitsL1",
    "JointPositionAction",
    "JointTorqueLimitsL1",
    "JointVelL2",
    "KernelReward",
    "KernelTermination",
    "LostContact",
    "MassRandomization",
    "Metrics",
    "MotionEnd",
    "MotionReference",
    "ObjectJointRandomization",
    "ObjectScale",
    "PointInRoot",
    "PoseInRoot",
    "ProjectedGravity",
    "RandomPush",
    "ReferenceStateInitialization",
    "RelativeJointPos",
    "ResetNoiseCurriculum",
    "ResidualAction",
    "RewardGroups",
    "RewardRate",
    "RewardTerm",
    "Rewind",
    "SpringAssist",
    "SurvivalReward",
    "TerminationTerm",
    "TrackedBodies",
    "TrackingReward",
    "UniformNoise",
    "VectorInRoot",
]
