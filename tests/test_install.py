"""The package as it is installed: a wheel, in a folder that has nothing of the checkout; packages with tasks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mocks import command

from hdmi.commands.verbs import VERBS
from hdmi.config import ConfigError, task_config, task_files

ROOT = Path(__file__).parents[1]
LIFT_BOX = (ROOT / "conf" / "task" / "lift_box.yaml").read_text(encoding="utf-8")
TINY = [
    "num_envs=64", "total_frames=4096", "eval_envs=2", "num_threads=1", "video=false", "logger=csv", "task=lift_box",
]  # fmt: skip


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel's files, and nothing else."""
    built, folder = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("site")
    # from the sdist, as a release is; what is needed to build is there already
    install = ["pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder)]
    for arguments in (
        ["build", "--no-isolation", "--outdir", str(built), str(ROOT)],
        [*install, "--find-links", str(built), "hdmi"],
    ):
        done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder


def files_in(folder: Path) -> set[str]:
    paths = {path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"}
    return {path.relative_to(folder).as_posix() for path in paths}


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A folder with somebody's own `conf`, which has nothing to do with this package."""
    (tmp_path / "conf" / "task").mkdir(parents=True)
    for name in ("config.yaml", "task/lift_box.yaml"):
        (tmp_path / "conf" / name).write_text("a: [broken", encoding="utf-8")
    return tmp_path


@pytest.fixture
def own_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Installs a package with a task of its own, and an entry point that names the folder; returns the folder."""

    def make(package: str = "kitchen", *, names: str | None = None, config: str = "task/stir", code: str = "") -> Path:
        monkeypatch.delitem(sys.modules, package, raising=False)  # of another test
        site = tmp_path / f"site_{package}"
        file = site / package / "conf" / f"{config}.yaml"
        file.parent.mkdir(parents=True)
        file.write_text(LIFT_BOX.replace("name: lift_box", f"name: {file.stem}"), encoding="utf-8")
        (site / package / "__init__.py").write_text(code, encoding="utf-8")
        info = site / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[hdmi.configs]\ntasks = {names or f'{package}.conf'}\n")
        monkeypatch.syspath_prepend(site)
        return site / package / "conf"

    return make


def hdmi(*site: Path, arguments: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """The installed command; the interpreter looks for modules in folders of installed packages first."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, site)), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-P", str(site[0] / "bin" / "hdmi"), *arguments]
    return subprocess.run(line, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.xdist_group("install")
class TestWheel:
    def test_what_is_in_it(self, installed: Path):
        (info,) = installed.glob("hdmi-*.dist-info")
        assert {path.name for path in installed.iterdir()} == {"bin", "hdmi", info.name}
        assert {path.name for path in info.glob("licenses/*")} == {"LICENSE", "NOTICE"}
        package = files_in(installed / "hdmi")
        assert package == files_in(ROOT / "hdmi") | {f"conf/{name}" for name in files_in(ROOT / "conf")}
        assert {"py.typed", "conf/config.yaml", "motion/references/walk/motion.npz"} <= package

    def test_it_is_what_is_imported(self, installed: Path, elsewhere: Path):
        environment = os.environ | {"PYTHONPATH": str(installed)}
        ask = "from hdmi import config, __file__; print(__file__, config.CONF)"
        done = subprocess.run(
            [sys.executable, "-P", "-c", ask],
            cwd=elsewhere,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.split() == [str(installed / "hdmi" / "__init__.py"), str(installed / "hdmi" / "conf")]

    def test_verbs(self, installed: Path, elsewhere: Path):
        done = hdmi(installed, arguments=["--help"], cwd=elsewhere)
        assert done.returncode == 0
        assert [line.split()[1] for line in done.stdout.splitlines()[2:]] == list(VERBS)
        wrong = hdmi(installed, arguments=["trian"], cwd=elsewhere)
        assert wrong.returncode == 2
        assert wrong.stderr.startswith("there is no verb 'trian' (did you mean train?)")
        assert wrong.stderr.count("\n") == 1

    @pytest.mark.slow
    def test_tasks_with_those_of_a_package(self, installed: Path, elsewhere: Path, own_package: Callable[..., Path]):
        kitchen = own_package().parents[1]
        listed = hdmi(installed, kitchen, arguments=["tasks"], cwd=elsewhere)
        assert listed.returncode == 0, listed.stderr
        assert "truman_bow" in listed.stdout
        assert "stir" in listed.stdout
        assert "cannot be used" not in listed.stdout

    @pytest.mark.slow
    def test_training(self, installed: Path, elsewhere: Path):
        done = hdmi(installed, arguments=["train", *TINY], cwd=elsewhere)
        assert done.returncode == 0, done.stdout + done.stderr
        (run,) = (elsewhere / "runs" / "lift_box").iterdir()
        assert {"config.yaml", "metrics.csv", "eval.json", "checkpoints"} <= {path.name for path in run.iterdir()}
        assert list((run / "checkpoints").iterdir())
        assert {path.name for path in elsewhere.iterdir()} == {"conf", "runs"}


# -- what a command says --------------------------------------------------------------------------------------


def typed(monkeypatch: pytest.MonkeyPatch, verb: str, *arguments: str) -> int:
    """Runs a verb as the command line does; returns its exit status."""
    from hdmi.commands.verbs import main

    monkeypatch.setattr(sys, "argv", ["hdmi", verb, *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize("verb", VERBS)
def test_help_names_the_verb(verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert typed(monkeypatch, verb, "--help") == 0
    said = capsys.readouterr().out
    assert f"hdmi {verb} " in said
    assert "train.py" not in said
    assert "scripts/" not in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["task=walc"], "ConfigError: In 'config': Could not find 'task/walc'; there is carry_bread_box, "),
        (["sede=1"], "ConfigError: Could not override 'sede'. To append to your config use +sede=1: Key 'sede' is not"),
        (["seed=1,2"], "ConfigError: Ambiguous value for argument 'seed=1,2'"),
        (["a b"], "ConfigError: "),
        (["--config-dir=nowhere"], "ConfigError: Additional config directory "),
    ],
)
@pytest.mark.parametrize("verb", ["train", "benchmark"])
def test_what_cannot_be_composed_is_one_line(
    verb: str,
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    assert typed(monkeypatch, verb, *arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(message)
    assert said.count("\n") == 1
    assert "HYDRA_FULL_ERROR" not in os.environ
    assert not list(tmp_path.iterdir())


# -- packages with tasks --------------------------------------------------------------------------------------


class TestPackagesOfOthers:
    def test_their_tasks_are_tasks(self, own_package: Callable[..., Path]):
        kitchen, pantry = own_package(), own_package("pantry", config="task/shelve")
        assert task_files()["stir"] == kitchen / "task" / "stir.yaml"
        assert task_files()["shelve"] == pantry / "task" / "shelve.yaml"
        assert task_config("stir").task.name == "stir"

    def test_several_folders_of_one(self, own_package: Callable[..., Path]):
        folder = own_package()
        more = folder.parent / "more" / "task"
        more.mkdir(parents=True)
        (more / "fry.yaml").write_text(LIFT_BOX, encoding="utf-8")
        points = folder.parents[1] / "kitchen-1.0.dist-info" / "entry_points.txt"
        points.write_text("[hdmi.configs]\ntasks = kitchen.conf\nmore = kitchen.more\nagain = kitchen.conf\n")
        assert {"stir", "fry"} <= set(task_files())

    @pytest.mark.parametrize("verb", ["train", "benchmark"])
    def test_commands_of_hydra_find_them(
        self,
        verb: str,
        own_package: Callable[..., Path],
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ):
        own_package()
        monkeypatch.setattr(sys, "argv", [verb, "task=stir", "--cfg=job", "--package=task"])
        command(verb).main()
        assert "name: stir" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (
                {"names": "kitchen.menu"},
                "package kitchen: its entry point 'tasks' of hdmi.configs names kitchen.menu, which is no package with "
                "a folder",
            ),
            (
                {"names": "cellar.conf"},
                "package kitchen: .*cellar.conf, which cannot be imported: ModuleNotFoundError: .*cell",
            ),
            ({"names": "kitchen.conf:task"}, "package kitchen: .*names kitchen.conf:task, which is no package with"),
            ({"code": "1 / 0"}, "package kitchen: .*kitchen.conf, which cannot be imported: ZeroDivisionError: div"),
            ({"code": "import cellar"}, "package kitchen: .*cannot be imported: ModuleNotFoundError: .*'cellar'"),
            ({"config": "task/walk"}, "package kitchen: .*/walk.yaml: there is .*conf/task/walk.yaml already; give it"),
            ({"config": "object/door"}, "package kitchen: .*/door.yaml: there is .*conf/object/door.yaml already"),
            ({"config": "config"}, "package kitchen: .*/config.yaml: there is .*conf/config.yaml already"),
        ],
    )
    def test_what_is_wrong_with_one_names_it(
        self,
        change: dict[str, str],
        message: str,
        own_package: Callable[..., Path],
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ):
        own_package(**change)
        with pytest.raises(ConfigError, match=message) as caught:
            task_files()
        for verb in ("train", "tasks"):
            assert typed(monkeypatch, verb, "task=lift_box" if verb == "train" else "motion_root=x") == 2
            assert capsys.readouterr().err == f"ConfigError: {caught.value}\n"

    def test_two_with_a_task_of_one_name(self, own_package: Callable[..., Path]):
        own_package()
        own_package("pantry")
        with pytest.raises(ConfigError, match=r"package (kitchen|pantry): .*/stir.yaml: there is .*/stir.yaml already"):
            task_files()
