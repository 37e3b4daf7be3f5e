"""The package as it is installed: a wheel, in a folder that has nothing of the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hdmi.config import ConfigError, task_config, task_files

ROOT = Path(__file__).parents[1]
TINY = [
    "num_envs=64", "total_frames=4096", "eval_envs=2", "num_threads=1", "video=false", "logger=csv", "task=push_box",
]  # fmt: skip


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel's files, and nothing else."""
    built, folder = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("site")
    # from the sdist, as a release is; what is needed to build is there already
    install = ["pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder)]
    for command in (
        ["build", "--no-isolation", "--outdir", str(built), str(ROOT)],
        [*install, "--find-links", str(built), "hdmi"],
    ):
        done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder


def hdmi(installed: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The installed command, which must not find the checkout."""
    start = (
        "import hdmi, sys; assert hdmi.__file__.startswith(sys.argv.pop(1)); import hdmi.commands.verbs as v; v.main()"
    )
    environment = os.environ | {"PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", start, str(installed), *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.xdist_group("install")
class TestWheel:
    def test_what_is_in_it(self, installed: Path):
        assert {path.name for path in installed.iterdir()} == {"bin", "hdmi", f"hdmi-{_version(installed)}.dist-info"}
        assert (installed / "hdmi" / "conf" / "config.yaml").is_file()
        assert (installed / "hdmi" / "py.typed").is_file()
        assert len(list((installed / "hdmi" / "motion" / "references").iterdir())) == 16
        assert list((installed / "hdmi" / "workshop" / "author" / "plans").glob("*.yaml"))
        assert {path.name for path in installed.glob("*.dist-info/licenses/*")} == {"LICENSE", "NOTICE"}

    def test_verbs(self, installed: Path, tmp_path: Path):
        done = hdmi(installed, "--help", cwd=tmp_path)
        assert done.returncode == 0
        assert "hdmi evaluate" in done.stdout
        (tmp_path / "conf").mkdir()  # somebody's own, which has nothing to do with it
        listed = hdmi(installed, "tasks", cwd=tmp_path)
        assert listed.returncode == 0, listed.stderr
        assert "truman_bow" in listed.stdout
        wrong = hdmi(installed, "trian", cwd=tmp_path)
        assert wrong.returncode == 2
        assert wrong.stderr.startswith("there is no verb 'trian' (did you mean train?)")

    def test_training(self, installed: Path, tmp_path: Path):
        done = hdmi(installed, "train", *TINY, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        (run,) = (tmp_path / "runs" / "push_box").iterdir()
        assert (run / "eval.json").is_file()
        assert list((run / "checkpoints").iterdir())
        assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def _version(installed: Path) -> str:
    (info,) = installed.glob("*.dist-info")
    return info.name.removeprefix("hdmi-").removesuffix(".dist-info")


@pytest.fixture
def own_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Installs a package `kitchen`, with a task of its own."""

    def make(names: str = "kitchen.conf", task: str = "stir") -> None:
        write_package(tmp_path, names, task)
        monkeypatch.syspath_prepend(tmp_path)

    monkeypatch.delitem(sys.modules, "kitchen", raising=False)  # of another test
    return make


def write_package(folder: Path, names: str, task: str) -> None:
    conf = folder / "kitchen" / "conf" / "task"
    conf.mkdir(parents=True)
    text = (ROOT / "conf" / "task" / "lift_box.yaml").read_text(encoding="utf-8")
    (conf / f"{task}.yaml").write_text(text.replace("name: lift_box", f"name: {task}"), encoding="utf-8")
    (folder / "kitchen" / "__init__.py").write_text("")
    info = folder / "kitchen-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kitchen\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[hdmi.configs]\ntasks = {names}\n")


class TestPackagesOfOthers:
    def test_their_tasks_are_tasks(self, own_package: Callable[..., None], tmp_path: Path):
        own_package()
        assert task_files()["stir"] == tmp_path / "kitchen" / "conf" / "task" / "stir.yaml"
        assert task_config("stir").task.name == "stir"

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"names": "kitchen.menu"}, "package kitchen: its entry point 'tasks' of hdmi.configs names kitchen.menu"),
            ({"names": "pantry.conf"}, "package kitchen: .* names pantry.conf, which is no package with a folder"),
            ({"task": "walk"}, "package kitchen: .*walk.yaml: there is a task 'walk' already"),
        ],
    )
    def test_what_is_wrong_with_one_names_it(
        self, change: dict[str, str], message: str, own_package: Callable[..., None]
    ):
        own_package(**change)
        with pytest.raises(ConfigError, match=message):
            task_files()
