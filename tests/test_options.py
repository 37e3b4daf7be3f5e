"""What the scripts take: arguments as text, tasks of one's own folder, and scenes with something wrong in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mocks import CONF, command

from hdmi.assembly import scene_parts
from hdmi.commands.options import parse_motion_options, parse_options, parse_terminations
from hdmi.config import ConfigError, task_config
from hdmi.motion import find_motion

SHIPPED = str(find_motion("lift_box"))
LIFT_BOX = (CONF / "task" / "lift_box.yaml").read_text(encoding="utf-8")


@dataclass
class Options:
    out: str | None = None
    name: str = "walk"
    count: int = 4
    scale: float | None = None
    fast: bool = False
    names: list[str] = field(default_factory=lambda: ["all"])
    worlds: list[int] = field(default_factory=list)


# -- values ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "02_01", "1e3", "0x10", "true", "null", "no", "[x].bvh", "%a", "@b", "*c", "{d}", "{d: 1}", "'e", '"f"', "#g",
        "h # i", "a=b", "a/lr=0.1,seed=2/b", " blank ", "1:30", "${oc.env:HOME}", "2026-01-01", "a\\b", "ü", "-", "~",
        "!x", "&x", "a, b", "???",
    ],
)  # fmt: skip
@pytest.mark.parametrize("key", ["out", "name"])
def test_text_is_what_stands_after_the_first_equals_sign(key: str, text: str):
    assert getattr(parse_options(Options, [f"{key}={text}"]), key) == text


@given(st.text(min_size=1))
def test_any_text_is_kept(text: str):
    assert parse_options(Options, [f"out={text}"]).out == text


@pytest.mark.parametrize(
    ("argument", "key", "value"),
    [
        ("count=8", "count", 8),
        ("count=65_536", "count", 65_536),
        ("count=-1", "count", -1),
        ("scale=0.5", "scale", 0.5),
        ("scale=1e-2", "scale", 0.01),
        ("scale=2", "scale", 2.0),
        ("scale=null", "scale", None),
        ("fast=true", "fast", True),
        ("fast=False", "fast", False),
        ("names=[root_pose,object_pose]", "names", ["root_pose", "object_pose"]),
        ("names=root_pose, object_pose", "names", ["root_pose", "object_pose"]),
        ("names=root_pose", "names", ["root_pose"]),
        ("names=[]", "names", []),
        ("names=[a=[1,2],b]", "names", ["a=[1,2]", "b"]),
        ("worlds=[8,16]", "worlds", [8, 16]),
    ],
)
def test_values_have_the_declared_type(argument: str, key: str, value: object):
    found = getattr(parse_options(Options, [argument]), key)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("count=many", "count: a whole number expected, got 'many'"),
        ("count=1.5", "count: a whole number expected, got '1.5'"),
        ("count=", "count: a value expected"),
        ("out=", "out: a value expected"),
        ("scale=big", "scale: a number expected, got 'big'"),
        ("scale=nan", "scale: a number expected, got 'nan'"),
        ("fast=maybe", "fast: true or false expected, got 'maybe'"),
        ("worlds=[8,x]", "worlds: a whole number expected, got 'x'"),
        ("nmae=x", r"unknown option 'nmae' \(did you mean name\?\); there is out, name,"),
        ("--out=x", r"unknown option '--out' \(did you mean out\?\)"),
        ("runs/a", "'runs/a': expected key=value; the keys are out, name,"),
    ],
)
def test_mistakes_say_what_would_be_right(argument: str, message: str):
    with pytest.raises(ConfigError, match=message):
        parse_options(Options, [argument])


@pytest.mark.parametrize(
    ("value", "names"),
    [
        (["all"], None),
        ("all", None),
        (["none"], []),
        ([], []),
        ("[a,b]", ["a", "b"]),
        (["a", "b"], ["a", "b"]),
        ("a", ["a"]),
    ],
)
def test_terminations(value: str | list[str], names: list[str] | None):
    assert parse_terminations(value) == names


# -- paths among options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["walk", "runs/lr=0.1/walk", "lr=0.1", "a b", "[x]", "#1", "x=y=z", "./name=walk"])
@pytest.mark.parametrize("order", [1, -1])
def test_the_motion_is_the_argument_that_is_no_option(
    folder: str, order: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / folder).mkdir(parents=True)
    path, options = parse_motion_options(Options, [folder, "name=b=c"][::order])
    assert path == Path(folder)
    assert options.name == "b=c"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["walk", "nmae=x"], r"unknown option 'nmae' \(did you mean name\?\)"),
        (["nmae=x"], "unknown option 'nmae'.*nor is there a folder nmae=x"),
        ([], "give one motion folder, got none"),
        (["name=x"], "give one motion folder, got none"),
        (["walk", "run"], "give one motion folder, got walk, run"),
    ],
)
def test_a_misspelled_option_is_no_motion(arguments: list[str], message: str):
    with pytest.raises(ConfigError, match=message):
        parse_motion_options(Options, arguments)


def test_a_folder_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]):
    assert command("validate").main(["runs/lr=0.1/walk"]) == 2
    assert "runs/lr=0.1/walk: no such folder" in capsys.readouterr().err


# -- tasks of one's own ---------------------------------------------------------------------------------------


def own_task(folder: Path, text: str = LIFT_BOX, name: str = "my_box") -> Path:
    """A folder as for `--config-dir`, with a task."""
    (folder / "task").mkdir(parents=True, exist_ok=True)
    text = text.replace("name: lift_box", f"name: {name}", 1)
    (folder / "task" / f"{name}.yaml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def scripts(tmp_path: Path) -> dict[str, list[str]]:
    """Scripts that take a task's name, with arguments that need little time."""
    return {
        "annotate": [SHIPPED, f"out={tmp_path / 'annotated'}", "task=my_box"],
        "validate": [SHIPPED, "task=my_box"],
        "view": [SHIPPED, "task=my_box", "start=9999"],
        "tasks": ["check", "my_box", "jobs=0"],
        "play": ["agent=reference", "task=my_box", "start=9999"],
        "evaluate": ["agent=zero", "task=my_box", "num_envs=1"],
        "author": ["task=my_box", "plan=nowhere.yaml", f"out={tmp_path / 'motions'}"],
        "retarget": ["source=nowhere.bvh", f"out={tmp_path / 'r'}", "object=my_box"],
    }


@pytest.mark.parametrize("folder", ["own", "lr=0.1, [a] 'b' #c"])
def test_config_dir_adds_tasks(folder: str, tmp_path: Path):
    cfg = task_config("my_box", config_dir=own_task(tmp_path / folder))
    assert cfg.task.name == "my_box"
    assert cfg.algo == task_config("lift_box").algo  # what it shares with others comes from conf


@pytest.mark.parametrize("script", ["annotate", "validate", "view", "play", "author"])
def test_scripts_take_tasks_of_a_folder(
    script: str, scripts: dict[str, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [*scripts[script], f"config_dir={own_task(tmp_path / 'own')}"]
    late = {"view": "start: expected", "play": "start: expected", "author": "nowhere.yaml"}.get(script)
    assert command(script).main(arguments) == (2 if late else 0)
    assert (late or "") in capsys.readouterr().err
    assert command(script).main(scripts[script]) == 2
    assert "there is no 'my_box'; there is carry_bread_box, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: folder / "nowhere", "config_dir: no folder "),
        (lambda folder: own_task(folder, name="walk"), "there is a task 'walk' already"),
        (lambda folder: own_task(folder, name="other"), "there is no 'my_box'; there is .*lift_box, .*other"),
        (lambda folder: own_task(folder, LIFT_BOX.replace("/preset: laptop", "kind: rigidd")), "my_box.yaml: .*rigidd"),
        (lambda folder: own_task(folder, "task: [unclosed"), "my_box.yaml: "),
    ],
)
def test_config_dir_that_does_not_do(change, message: str, tmp_path: Path):
    with pytest.raises(ConfigError, match=message):
        task_config("my_box", config_dir=change(tmp_path / "own"))


def test_tasks_lists_those_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    own_task(tmp_path / "own")
    own_task(tmp_path / "own", LIFT_BOX.replace("sphere", "box").replace("box: [0.12", "bocks: [0.12"), "broken")
    assert command("tasks").main([f"config_dir={tmp_path / 'own'}"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "my_box" in said
    assert "broken cannot be used: task.object.geoms[0]: unknown bocks" in said


# -- scenes with something wrong in them ----------------------------------------------------------------------

BOX = "geoms: [{box: [0.12, 0.14, 0.10]}]"
HINGE = "hinge: {{name: lid_joint, body: lid, geoms: [{{box: [0.1, 0.1, 0.01]}}], {}}}"
FAULTS = {
    "task.object.geoms[0].mesh: no file ": (BOX, "geoms: [{mesh: nowhere.obj}]"),
    "task.object.geoms[0].mesh: {folder}/points.obj: holds no faces": (BOX, "geoms: [{{mesh: {folder}/points.obj}}]"),
    "task.object.geoms[0].mesh: {folder}/plane.obj: encloses no volume": (BOX, "geoms: [{{mesh: {folder}/plane.obj}}]"),
    "task.object.geoms[1].mesh: {folder}/o.urdf: .urdf files hold no mesh": (
        BOX,
        "geoms: [{{sphere: 0.1}}, {{mesh: {folder}/o.urdf}}]",
    ),
    "task.object.geoms[0]: unknown bocks; there is box, sphere, ": (BOX, "geoms: [{bocks: [0.1, 0.1, 0.1]}]"),
    "task.object.geoms[0].box: 3 positive numbers expected, got (0.12, -0.14, 0.1)": (
        BOX,
        "geoms: [{box: [0.12, -0.14, 0.10]}]",
    ),
    "task.object.geoms[0]: give exactly one of ": (BOX, "geoms: [{box: [0.1, 0.1, 0.1], sphere: 0.1}]"),
    "task.object.geoms[0].quat: a quaternion": (BOX, "geoms: [{sphere: 0.1, quat: [0, 0, 0, 0]}]"),
    "task.object (ObjectConfig): object 'box': mass: 1 positive number expected, got 'heavy'": (
        "mass: 0.5",
        "mass: heavy",
    ),
    "task.object: ObjectConfig has no ['wieght']": ("mass: 0.5", "wieght: 0.5"),
    "task.object.hinge.range: the lower angle first": ("mass: 0.5", HINGE.format("range: [1.0, -1.0]")),
    "task.object.hinge.axis: a direction": ("mass: 0.5", HINGE.format("axis: [0, 0, 0]")),
    "hinge: unknown axle; there is name, body,": ("mass: 0.5", HINGE.format("axle: [0, 0, 1]")),
    "repeated name 'pelvis'": ("name: box", "name: pelvis"),
    "task.scenery[0].geoms[0]: unknown bocks": ("geoms: [{box: [0.14,", "geoms: [{bocks: [0.14,"),
    "task.effectors[1].body: robot has no body 'right_claw'; it has pelvis, ": ("right_wrist_yaw_link", "right_claw"),
    "task.effectors[0].target: 3 numbers expected": ("target: [0.0, 0.14, 0.05]", "target: [0.0, 0.14]"),
    "task.object: missing; the file's first line has to be `# @package _global_`": ("# @package _global_", "# mine"),
}


def broken_task(fault: str, folder: Path) -> str:
    """Writes the task with a fault; returns the message that it should get."""
    old, new = (text.replace("{folder}", str(folder)) for text in FAULTS[fault])
    assert old in LIFT_BOX
    own_task(folder, LIFT_BOX.replace(old, new.replace("{{", "{").replace("}}", "}"), 1))
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (folder / "plane.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    (folder / "o.urdf").write_text("<robot/>")
    return fault.replace("{folder}", str(folder))


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_a_scene_name_the_node(fault: str, tmp_path: Path):
    message = broken_task(fault, tmp_path)
    with pytest.raises(ConfigError) as caught:
        scene_parts(task_config("my_box", config_dir=tmp_path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("script", ["annotate", "validate", "view", "tasks", "play", "evaluate", "author", "retarget"])
def test_every_script_says_what_is_wrong_with_a_scene(
    script: str, scripts: dict[str, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    message = broken_task("task.object.geoms[0].mesh: {folder}/points.obj: holds no faces", tmp_path)
    arguments = [argument.replace("jobs=0", "jobs=1") for argument in scripts[script]]
    assert command(script).main([*arguments, f"config_dir={tmp_path}"]) == 2
    said = capsys.readouterr()
    assert said.err.strip() == f"ConfigError: {message}"
    assert "bad" not in said.out  # it says nothing about the motion
