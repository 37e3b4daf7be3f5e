"""SMPL's names for the joints of other skeletons: what exporters call them, and a file that says so."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdmi.motion.check import MotionError
from hdmi.motion.files import existing_file
from hdmi.workshop.human import SMPL_JOINTS

_PELVIS = ("hips", "hip", "pelvis")
# Without sides, separators, capitals and leading zeros. LAFAN1, Mixamo, CMU and MotionBuilder say UpLeg, Leg, Foot,
# Shoulder, Arm, ForeArm, Hand; Vicon, Xsens and SMPL name joints, Hip, Knee, Ankle, Collar, Shoulder, Elbow, Wrist;
# OptiTrack, Rokoko, Biped, Unreal, Unity, VRM and Blender segments.
_TRUNK = {
    "spine": "spine1", "spine1": "spine2", "spine2": "spine3", "upperchest": "spine3",
    "chest": "spine1", "chest2": "spine2", "chest3": "spine3",
    "neck": "neck", "head": "head",
} | dict.fromkeys(_PELVIS, "pelvis")  # fmt: skip
_LIMBS = {
    part: joint
    for joint, parts in {
        "hip": ("hip", "upleg", "upperleg", "thigh"),
        "knee": ("knee", "leg", "lowleg", "lowerleg", "shin", "calf"),
        "ankle": ("ankle", "foot"),
        "foot": ("toe", "toes", "toebase", "toe0", "ball"),
        "collar": ("collar", "clavicle"),
        "shoulder": ("shoulder", "arm", "uparm", "upperarm", "uarm", "shldr"),
        "elbow": ("elbow", "forearm", "lowarm", "lowerarm", "farm"),
        "wrist": ("wrist", "hand"),
    }.items()
    for part in parts
}
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


def smpl_names(theirs: Sequence[str], known: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """SMPL's names for the joints that are SMPL's; the others keep theirs.

    Capitals, separators and what all names have in front (`mixamorig:`, `Character1_`) or behind (`_jnt`, a number)
    do not matter; the pelvis's name tells what that is.

    Args:
        known: SMPL's name by theirs, for joints whose name says something else.
    """
    known = known or {}
    words = [_words(name) for name in theirs]
    prefix, suffix = next(
        (found for name, each in zip(theirs, words, strict=True) if name not in known and (found := _around(each))),
        ((), ()),
    )
    parts = [_part(each, prefix, suffix) for each in words]
    there = set(parts)
    trunk = dict(_TRUNK)
    if ("", "spine") not in there:  # counted from one
        trunk |= {"spine1": "spine1", "spine2": "spine2", "spine3": "spine3"}
    if ("", "neck") not in there:
        trunk["neck1"] = "neck"
    limbs = dict(_LIMBS)
    if {part for side, part in there if side} & {"arm", "uparm", "upperarm", "uarm", "shldr"}:
        limbs["shoulder"] = "collar"  # the arm hangs from a shoulder
    if {("left", "ankle"), ("right", "ankle")} & there:
        limbs["foot"] = "foot"
    ours: list[str] = []
    taken = set(known.values())
    for name, (side, part) in zip(theirs, parts, strict=True):
        joint = limbs.get(part) if side else trunk.get(part)
        mapped = known.get(name) or (f"{side}_{joint}" if side and joint else joint)
        if mapped is None or (mapped in taken and name not in known):
            mapped = name if name not in taken else f"{name}_{len(ours)}"
        taken.add(mapped)
        ours.append(mapped)
    return tuple(ours)


def read_names(path: str | Path, theirs: Sequence[str]) -> dict[str, str]:
    """SMPL's names by a file's, from YAML such as `thigh_left: left_hip`.

    Args:
        theirs: the joints that there are.

    Raises:
        MotionError: if it is no such file; names the entry.
    """
    try:
        values = OmegaConf.to_container(OmegaConf.load(existing_file(path)), resolve=False)
    except (OSError, UnicodeDecodeError, YAMLError, OmegaConfBaseException) as error:
        raise MotionError(f"{path}: not a YAML file: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(values, dict) or not values:
        raise MotionError(f"{path}: lines such as 'Bip01_L_Thigh: left_hip' expected, the file's name and SMPL's")
    found: dict[str, str] = {}
    for key, joint in values.items():
        name = str(key)
        if joint not in SMPL_JOINTS:
            raise MotionError(f"{path}: {name}: {joint!r} is none of SMPL's joints: {', '.join(SMPL_JOINTS)}")
        if name not in theirs:
            raise MotionError(f"{path}: {name}: there is no such joint among {', '.join(theirs)}")
        if joint in found.values():
            raise MotionError(f"{path}: {name}: {joint} is another joint's name already")
        found[name] = joint
    return found


def _words(name: str) -> tuple[str, ...]:
    words = []
    for word in _WORD.findall(name):
        if word[1:] in ("U", "F") and word[0] in "LR":  # OptiTrack's LUArm
            words += [word[0].lower(), word[1].lower()]
        elif word.isdecimal():
            words.append(str(int(word)))
        elif (side := re.match("left|right", word.lower())) and len(word) > len(side[0]):
            words += [side[0], word.lower()[len(side[0]) :]]
        else:
            words.append(word.lower())
    return tuple(words)


def _around(words: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """What is in front of and behind the pelvis's name, if it is that."""
    for i, word in enumerate(words):
        if word in _PELVIS and not _SIDES.keys() & set(words) and len(words) <= i + 2:
            prefix = words[:i]
            return (prefix[:-1] if prefix[-1:] == ("c",) else prefix), words[i + 1 :]
    return None


def _part(words: tuple[str, ...], prefix: tuple[str, ...], suffix: tuple[str, ...]) -> tuple[str, str]:
    """Side, or nothing, and the rest of the name."""
    if words[: len(prefix)] == prefix:
        words = words[len(prefix) :]
    if suffix and words and (words[-1:] == suffix or (words[-1].isdecimal() and suffix[0].isdecimal())):
        words = words[:-1]
    sides = {_SIDES[word] for word in words if word in _SIDES}
    rest = [word for word in words if word not in _SIDES and word != "c"]
    return (sides.pop() if len(sides) == 1 else "", "".join(rest))
