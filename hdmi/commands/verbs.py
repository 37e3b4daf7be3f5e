"""What the command `hdmi` can do: a verb for each module that has a `main`."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from importlib import import_module

# What each verb is for, in the order in which a user comes to need them.
VERBS = {
    "train": "trains a policy",
    "evaluate": "evaluates a checkpoint by the paper's protocol",
    "play": "plays a policy, or an agent that needs none, as a video or in a window",
    "record": "a policy's rollout as a reference motion to train on",
    "plot": "learning curves of runs side by side",
    "export": "writes a policy alone, with evaluation, video and a card",
    "deploy": "runs an exported policy on a robot, real or simulated",
    "simulate-robot": "a simulated robot that talks as the real one does, for deploy robot=unitree",
    "foreign": "brings in networks of others: describes one, checks it",
    "study": "trains variants over tasks and seeds, and reports what they come to",
    "tasks": "lists the tasks, checks them, or renders a picture of each",
    "retarget": "from a person's motion to the robot's",
    "convert": "reference motions from and to other projects' formats",
    "annotate": "finds contacts, and completes the object's trajectory",
    "validate": "whether a motion is worth training on",
    "repair": "puts a motion's feet on the ground and its hands on the object",
    "view": "shows a motion, as a video or in the browser",
    "author": "makes a motion from a plan of keyframes",
    "benchmark": "speed of physics, environment, learner and training",
    "gpu-report": "the benchmark by engine and number of worlds",
}
_HYDRA = ("train", "benchmark")  # read sys.argv themselves


def usage() -> str:
    """The verbs and what each is for."""
    lines = [f"    hdmi {verb:<14}  {what}" for verb, what in VERBS.items()]
    return "\n".join(["hdmi VERB [arguments]; hdmi VERB --help says more.", "", *lines])


def main() -> None:
    """Runs the verb that the command line names, and exits with its status."""
    verb, arguments = (sys.argv[1] if len(sys.argv) > 1 else "--help"), sys.argv[2:]
    if verb in ("-h", "--help"):
        print(usage())
        sys.exit(0)
    if verb not in VERBS:
        close = get_close_matches(verb, VERBS, 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        print(f"there is no verb {verb!r}{hint}; there is {', '.join(VERBS)}", file=sys.stderr)
        sys.exit(2)
    command = import_module(f"hdmi.commands.{verb.replace('-', '_')}").main
    if verb in _HYDRA:
        sys.argv = [f"hdmi {verb}", *arguments]
        command()
    else:
        sys.exit(command(arguments))
