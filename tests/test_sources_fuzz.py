"""Whatever a file holds, its reader returns finite numbers or says what is wrong with which file; it runs nothing."""

from __future__ import annotations

import os
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sources import robot_arrays, write_amass, write_bvh, write_gmr, write_gvhmr, write_intermimic, write_omomo

import hdmi.workshop.sources as readers
from hdmi.assets import g1
from hdmi.motion import Motion, MotionError, load_motion, save_motion
from hdmi.workshop.human import HumanMotion

FEW = settings(max_examples=25)


def _motion() -> Motion:
    arrays = robot_arrays()
    thing = {key: value[:, :1] for key, value in arrays.items() if key.startswith("body")}
    arrays |= {key: np.concatenate([arrays[key], value], axis=1) for key, value in thing.items()}
    return Motion("walk", 50.0, (*g1.BODY_NAMES, "box"), g1.JOINT_NAMES, **arrays)


Write = Callable[[Path], Any]
Read = Callable[[Path], Motion | HumanMotion]
READERS: dict[str, tuple[str, Write, Read]] = {
    "gvhmr": ("a.pt", write_gvhmr, lambda path: readers.read_gvhmr(path, 30.0)),
    "amass_smplh": ("a.npz", lambda path: write_amass(path, "smplh"), readers.read_amass),
    "amass_smplx": ("a.npz", lambda path: write_amass(path, "smplx"), readers.read_amass),
    "omomo": ("a.npz", write_omomo, readers.read_omomo),
    "intermimic": ("a_box_0.pt", write_intermimic, readers.read_intermimic),
    "bvh": ("a.bvh", write_bvh, readers.read_bvh),
    "mjlab": ("a.npz", lambda path: readers.write_mjlab(_motion(), path), readers.read_mjlab),
    "holosoma": ("a.npz", lambda path: readers.write_holosoma(_motion(), path), readers.read_holosoma),
    "csv": ("a.csv", lambda path: readers.write_robot_csv(_motion(), path), readers.read_robot_csv),
    "pickle": ("a.pkl", write_gmr, readers.read_robot_pickle),
    "hdmi": ("motion.npz", lambda path: save_motion(_motion(), path.parent), lambda path: load_motion(path.parent)),
}
every_reader = pytest.mark.parametrize("name", READERS)


@pytest.fixture(scope="module")
def samples() -> dict[str, bytes]:
    """A good file for each reader."""
    found = {}
    for name, (filename, write, read) in READERS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / filename
            write(path)
            read(path)
            found[name] = path.read_bytes()
    return found


def check(name: str, data: bytes) -> str | None:
    """Reads `data` as if it were a file; returns the error's message, if there is one."""
    filename, write, read = READERS[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / filename
        if name == "hdmi":
            write(path)
        path.write_bytes(data)
        try:
            motion = read(path)
        except MotionError as error:
            message = str(error)
        else:
            message = None
    if message is not None:
        assert folder in message
        return message
    for f in fields(motion):
        value = getattr(motion, f.name)
        if isinstance(value, np.ndarray):
            assert np.isfinite(value).all(), f.name
    return None


@every_reader
@FEW
@given(share=st.floats(0, 1, exclude_max=True))
def test_truncated(samples: dict[str, bytes], name: str, share: float) -> None:
    data = samples[name]
    error = check(name, data[: int(share * len(data))])
    # a table without its last rows is a table, and text may lose a digit or a blank
    assert error or name == "csv" or share > 0.99


@every_reader
@FEW
@given(changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=8))
def test_damaged(samples: dict[str, bytes], name: str, changes: list[tuple[float, int]]) -> None:
    data = bytearray(samples[name])
    for share, value in changes:
        data[int(share * len(data))] = value
    check(name, bytes(data))


@every_reader
@FEW
@given(data=st.binary(max_size=200))
def test_noise(name: str, data: bytes) -> None:
    assert check(name, data)


@every_reader
def test_other_readers_files(samples: dict[str, bytes], name: str) -> None:
    for data in samples.values():
        check(name, data)


dtypes = st.sampled_from(["f2", "f4", "f8", "i1", "i8", "u8", "b1", "c16", "U3", "S2", "M8[s]", "V3"])
numbers = st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, 1e30, -1e300, 1e-300])


@st.composite
def arrays(draw: st.DrawFn, like: np.ndarray) -> np.ndarray:
    """An array like another, but with a wrong value, dtype or shape."""
    kind = draw(st.sampled_from(["value", "all", "dtype", "shape", "empty", "frames"]))
    if kind in ("value", "all") and like.dtype.kind == "f" and like.size:
        out = np.array(like, dtype=np.float64)
        number = draw(numbers)
        if kind == "all":
            out[...] = number
        else:
            out.reshape(-1)[draw(st.integers(0, out.size - 1))] = number
        return out
    if kind == "dtype":
        return np.zeros(like.shape, dtype=draw(dtypes))
    if kind == "empty":
        return np.zeros(draw(st.sampled_from([(0,), (0, 3), (9, 0), ()])))
    if kind == "frames":
        return like[: draw(st.integers(0, 2))] if like.ndim else like
    return np.zeros(draw(st.lists(st.integers(0, 4), max_size=4)))


@pytest.mark.parametrize("name", [name for name, (filename, *_) in READERS.items() if filename.endswith(".npz")])
@given(data=st.data())
def test_wrong_arrays(samples: dict[str, bytes], name: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        path.write_bytes(samples[name])
        with np.load(path, allow_pickle=True) as file:
            content = {key: file[key] for key in file.files}
        key = data.draw(st.sampled_from(sorted(content)))
        if data.draw(st.booleans()):
            content[key] = data.draw(arrays(content[key]))
        else:
            del content[key]
        np.savez(path, **content)
        damaged = path.read_bytes()
    check(name, damaged)


@pytest.mark.parametrize("name", ["gvhmr", "intermimic"])
@settings(max_examples=40)
@given(data=st.data())
def test_wrong_tensors(name: str, data: st.DataObject) -> None:
    def changed(tensor: torch.Tensor) -> Any:
        kind = data.draw(st.sampled_from(["array", "list", "half", "grad", "sparse", "meta", "expanded", "none"]))
        if kind == "array":
            array = data.draw(arrays(tensor.numpy()).filter(lambda a: a.dtype.kind in "fiubc" and a.dtype != "u8"))
            return torch.from_numpy(np.ascontiguousarray(array))
        others: dict[str, Any] = {
            "list": tensor.tolist(),
            "half": tensor.bfloat16(),
            "grad": tensor.clone().requires_grad_(),
            "sparse": tensor.to_sparse(),
            "meta": tensor.to("meta"),
            "expanded": torch.zeros(1).expand(10**8, tensor.shape[-1]),
            "none": None,
        }
        return others[kind]

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pt"
        if name == "gvhmr":
            write_gvhmr(path)
            content = torch.load(path, weights_only=True)
            key = data.draw(st.sampled_from(sorted(content["smpl_params_global"])))
            content["smpl_params_global"][key] = changed(content["smpl_params_global"][key])
        else:
            write_intermimic(path)
            content = changed(torch.load(path, weights_only=True))
        torch.save(content, path)
        damaged = path.read_bytes()
    check(name, damaged)


words = st.one_of(
    st.sampled_from(
        [
            "HIERARCHY",
            "ROOT",
            "JOINT",
            "End",
            "Site",
            "{",
            "}",
            "OFFSET",
            "CHANNELS",
            "3",
            "6",
            "Hips",
            "LeftLeg",
            "Xposition",
            "Zrotation",
        ]
    ),
    st.sampled_from(["MOTION", "Frames:", "Frame", "Time:", "0.03", "2", "1", "-1", "nan", "1e400", "²"]),
    st.text(max_size=3),
)


@FEW
@given(text=st.lists(words, max_size=60).map(" ".join))
def test_text_that_resembles_a_bvh(text: str) -> None:
    assert check("bvh", text.encode("utf-8", "replace"))


@FEW
@given(data=st.data())
def test_a_bvh_in_any_case_and_spacing_is_the_same(samples: dict[str, bytes], data: st.DataObject) -> None:
    text = samples["bvh"].decode()
    for word in (
        "HIERARCHY",
        "ROOT",
        "JOINT",
        "End Site",
        "OFFSET",
        "CHANNELS",
        "Zrotation",
        "MOTION",
        "Frames",
        "Time",
    ):
        case = data.draw(st.sampled_from([str.upper, str.lower, str.capitalize, str.swapcase]))
        text = text.replace(word, case(word))
    for old, new in (("\n", ["\n", "\r\n", "\n\n", " \n\t"]), (": ", [":", ": ", ":\t", " : "])):
        text = text.replace(old, data.draw(st.sampled_from(new)))
    with tempfile.TemporaryDirectory() as folder:
        path, other = Path(folder) / "a.bvh", Path(folder) / "b.bvh"
        path.write_bytes(samples["bvh"])
        other.write_text(data.draw(st.sampled_from(["", "\ufeff"])) + text, newline="")
        np.testing.assert_array_equal(readers.read_bvh(other).joint_pos, readers.read_bvh(path).joint_pos)


@settings(max_examples=60)
@given(turn=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_person_in_any_world_stands_or_is_told_not_to(turn: list[float]) -> None:
    """Whatever the axes of a file: its person stands, or the error names the axis to stand along, or a note says so."""
    world = Rotation.from_quat(turn)
    with tempfile.TemporaryDirectory() as folder:
        path = write_amass(Path(folder) / "a.npz", "smplh")
        with np.load(path) as file:
            poses, trans = file["poses"], file["trans"]
        poses[:, :3] = (world * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
        write_amass(path, "smplh", poses=poses, trans=world.apply(trans))
        try:
            motion = readers.read_amass(path)
        except MotionError as error:
            up = str(error).partition("give up=")[2].partition(",")[0]
            motion = readers.read_amass(path, up=up)
            least = 0.8
        else:
            least = -1.0 if any("trunk leans" in note for note in motion.notes) else 0.5
    trunk = np.median(motion.pos("neck") - motion.pos("pelvis"), axis=0)
    assert trunk[2] > (least - 0.1) * np.linalg.norm(trunk)


@FEW
@given(rows=st.lists(st.lists(st.one_of(numbers.map(str), st.text(max_size=3)), max_size=40), max_size=4))
def test_text_that_resembles_a_csv(rows: list[list[str]]) -> None:
    check("csv", "\n".join(",".join(row) for row in rows).encode("utf-8", "replace"))


class Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


@every_reader
def test_hostile_pickles_are_not_run(name: str, tmp_path: Path) -> None:
    filename = READERS[name][0]
    ran = tmp_path / "ran"
    files = [pickle.dumps(Hostile(ran), protocol) for protocol in (0, 2, 4)]
    for content in (Hostile(ran), {"smpl_params_global": Hostile(ran)}, [torch.zeros(3), Hostile(ran)]):
        for zipped in (True, False):
            torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
            files.append((tmp_path / "a.pt").read_bytes())
    keys = "poses trans betas mocap_framerate seq_name rest_offsets obj_rot joint_pos joint_names body_pos_w fps"
    hostile = np.array([Hostile(ran)], dtype=object)
    np.savez(tmp_path / "a.npz", allow_pickle=True, **dict.fromkeys(keys.split(), hostile))
    np.save(tmp_path / "a.npy", hostile, allow_pickle=True)
    files += [(tmp_path / "a.npz").read_bytes(), (tmp_path / "a.npy").read_bytes()]
    for data in files:
        assert check(name, data), filename
    assert not ran.exists()
    pickle.loads(files[0])
    assert ran.exists()  # where it is let, it does run


@every_reader
def test_missing_files_and_folders(name: str, tmp_path: Path) -> None:
    _, _, read = READERS[name]
    with pytest.raises(MotionError, match="no such file"):
        read(tmp_path / "none" / READERS[name][0])
    folder = tmp_path / "folder.npz"
    (folder / READERS[name][0]).mkdir(parents=True)
    with pytest.raises(MotionError, match="no such file"):
        read(folder / READERS[name][0])


def test_an_archive_that_unpacks_to_more_than_fits_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hdmi.motion.files.MAX_BYTES", 100_000)
    np.savez_compressed(tmp_path / "a.npz", trans=np.zeros((10_000, 3)), poses=np.zeros(1), other=np.zeros(10**6))
    with pytest.raises(MotionError, match="GiB of data"):
        readers.read_amass(tmp_path / "a.npz")
