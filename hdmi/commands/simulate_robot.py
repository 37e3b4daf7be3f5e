"""A simulated G1 that talks as the real one does, for `hdmi deploy robot=unitree`: needs neither torch nor hydra.

    hdmi simulate-robot scene=FOLDER/scene.xml [loss=0.05] [delay=0.004] [mocap_dropout=0.1] ...
    hdmi simulate-robot send="reset 3"      # to one that runs: reset [EPISODE], release, press BUTTON

It sends states and takes commands over DDS, and publishes poses over ZMQ. The root is held where the motion starts,
until `gantry` s after the first command with stiffness: long enough for deploy to go to the start. Ctrl-C ends it.

{options}
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hdmi.commands.deployed import run_deployed
from hdmi.commands.options import parse_parts, shown_help
from hdmi.deploy import simulator
from hdmi.deploy.format import GRAPH_FILE, SCENE_FILE
from hdmi.deploy.policy import Policy
from hdmi.errors import ConfigError


@dataclass
class Options:
    """See the module."""

    scene: str | None = None  # an exported policy's scene.xml, or its folder
    send: str | None = None  # asks a simulated robot that runs for something


def run(arguments: list[str], console: Console) -> int:
    """Does what the options ask for; returns the exit status."""
    values = parse_parts((Options, simulator.Network, simulator.Options), arguments)
    options, network = values[Options], values[simulator.Network]
    if options.send is not None:
        answer = simulator.ask(network.control, options.send)
        console.print(answer, markup=False)
        return 0 if answer == simulator.DONE else 1
    if options.scene is None:
        raise ConfigError(f"give scene=FOLDER/{SCENE_FILE}, that of an exported policy")
    scene = Path(options.scene)
    scene = scene / SCENE_FILE if scene.is_dir() else scene
    description = Policy(scene.with_name(GRAPH_FILE)).description

    def say(text: str) -> None:
        console.print(text, markup=False, highlight=False)

    robot = simulator.Simulator(description, scene, values[simulator.Options], say)
    say(
        f"a G1 at the start of {description.task}: DDS on {network.interface}, domain {network.domain}; "
        f"poses on {network.poses}; control on {network.control}; Ctrl-C ends it"
    )
    late = simulator.serve(robot, network)
    counts = ", ".join(f"{name} {count}" for name, count in robot.counts.items())
    say(f"{robot.steps} steps; {counts}; {late:.2f} s behind the clock")
    return 0


def _help() -> str:
    return shown_help(__doc__, {"network": simulator.Network, "robot": simulator.Options})


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit status: 2 after a mistake, 1 if what was asked for is refused."""
    return run_deployed(run, arguments, _help)
