"""Pickles as data: what is in them is read opcode by opcode, and nothing of theirs is ever called.

A pickle is a program. Projects that write motions use a harmless part of that language: numbers, strings, containers
and numpy arrays. This module knows that part and no other. It runs neither `pickle` nor `joblib`: opcodes come from
`pickletools.genops`, names of functions are only compared with the few that numpy and joblib need to say "here is an
array", and the array is made here, from bytes that the file does hold. Any other name is refused with that name.
"""

from __future__ import annotations

import bz2
import io
import lzma
import math
import pickletools
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hdmi.motion import files
from hdmi.motion.check import MotionError

_NUMPY = ("numpy.core.", "numpy._core.")  # before and since numpy 2
_JOBLIB_ARRAY = "joblib.numpy_pickle.NumpyArrayWrapper"
_DTYPE = re.compile(r"(\?|[biufc]\d+|[SU]\d*)")
_MARK = object()
_KEYS = (str, int, float, bytes, bool, type(None))


def read_plain_pickle(path: str | Path) -> Any:
    """What a pickle holds: numbers, strings, lists, tuples, sets, dicts and numpy arrays.

    Reads what `pickle.dump` (protocols 0 to 5) and `joblib.dump` write, the latter also if compressed by zlib, gzip,
    bz2, xz or lzma.

    Raises:
        MotionError: if the file is missing or damaged, unpacks to more than a motion has, or wants anything else to
            be loaded or called; names what.
    """
    path = files.existing_file(path)
    data = _unpacked(path, path.read_bytes())
    try:
        return _Machine(path, io.BytesIO(data), len(data)).run()
    except MotionError:
        raise
    except Exception as error:  # a damaged file raises what it likes
        first = (str(error).splitlines() or [""])[0]
        raise MotionError(
            f"{path}: truncated, or not a pickle of plain data: {type(error).__name__}: {first}"
        ) from error


def _unpacked(path: Path, data: bytes) -> bytes:
    limit = files.MAX_BYTES
    if data.startswith(b"PK\x03\x04"):
        raise MotionError(f"{path}: not a pickle but a zip archive, as torch.save and numpy.savez write them")
    if data.startswith(b"\x04\x22\x4d\x18"):
        raise MotionError(f"{path}: compressed by lz4: write it with joblib.dump(..., compress='zlib')")
    unpackers: dict[tuple[bytes, ...], Callable[[], Any]] = {
        (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda"): zlib.decompressobj,
        (b"\x1f\x8b",): lambda: zlib.decompressobj(wbits=31),
        (b"BZh",): bz2.BZ2Decompressor,
        (b"\xfd7zXZ", b"\x5d\x00\x00"): lzma.LZMADecompressor,
    }
    for magic, unpacker in unpackers.items():
        if data.startswith(magic):
            try:
                unpacked: bytes = unpacker().decompress(data, limit + 1)
            except (zlib.error, OSError, EOFError, lzma.LZMAError) as error:
                raise MotionError(f"{path}: damaged: {error}") from error
            if len(unpacked) > limit:
                raise MotionError(f"{path}: unpacks to more than {limit / 2**30:.1f} GiB, more than a motion has")
            return unpacked
    return data


class _Name:
    """A name that the file mentions. It stands for nothing."""

    def __init__(self, name: str) -> None:
        self.name = name


class _DType:
    """A numpy dtype of numbers or strings in the making."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "="

    @property
    def numpy(self) -> np.dtype[Any]:
        return np.dtype(self.order + self.code if self.code != "?" else "?")


class _Array:
    """An array whose content is still to come, and where it was remembered until then."""

    def __init__(self, wrapped: bool = False) -> None:
        self.wrapped = wrapped  # by joblib: the content follows in the file
        self.memo_keys: list[int] = []


class _Machine:
    """A stack and a memo, as the pickle language has them."""

    def __init__(self, path: Path, file: io.BytesIO, size: int) -> None:
        self.path, self.file, self.size = path, file, size
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.made = 0  # bytes, about, of what calls made: a call is short, what it copies may be long
        self.calls: dict[str, Callable[..., Any]] = {
            "numpy.dtype": self._dtype,
            "_codecs.encode": lambda text, encoding="latin1": self._bytes(text),
            "collections.OrderedDict": self._pairs,
        }
        for module in ("builtins", "__builtin__"):
            self.calls |= {f"{module}.set": lambda items=(): set(self._keys(self._counted(items)))}
            self.calls |= {f"{module}.frozenset": lambda items=(): frozenset(self._keys(self._counted(items)))}
            self.calls |= {f"{module}.bytearray": self._bytes, f"{module}.bytes": self._bytes}
        for module in _NUMPY:
            self.calls |= {f"{module}multiarray._reconstruct": lambda *_: _Array()}
            self.calls |= {f"{module}multiarray.scalar": self._scalar}
            self.calls |= {f"{module}numeric._frombuffer": self._from_buffer}

    def run(self) -> Any:
        for opcode, argument, _ in pickletools.genops(self.file):
            step = getattr(self, f"_op_{opcode.name.lower()}", None)
            if opcode.name in _CONSTANTS:
                self.stack.append(argument)
            elif step is not None:
                step(argument)
            elif opcode.name not in ("PROTO", "FRAME", "STOP"):
                raise self._refused(f"the opcode {opcode.name}")
        return self.stack.pop()

    def _refused(self, what: str) -> MotionError:
        return MotionError(
            f"{self.path}: wants {what}: of a pickle only numbers, strings, containers and numpy arrays are read; "
            "export the arrays with numpy.savez, or a CSV"
        )

    # -- values ----------------------------------------------------------------------------------------------

    def _dtype(self, code: str, *_: object) -> _DType:
        if not isinstance(code, str) or not (_DTYPE.fullmatch(code) or code in ("O", "O8")):
            raise self._refused(f"the dtype {code!r}")
        return _DType(code)

    def _counted(self, value: Any) -> Any:
        self.made += len(value) * (1 if isinstance(value, str | bytes | bytearray) else 64)
        if self.made > files.MAX_BYTES:
            raise MotionError(f"{self.path}: unpacks to more than {files.MAX_BYTES / 2**30:.1f} GiB")
        return value

    def _bytes(self, value: object = b"", encoding: str = "latin1") -> bytes:
        if isinstance(value, bytes):
            return value
        if not isinstance(value, str | bytearray):
            raise self._refused(f"bytes of a {type(value).__name__}")
        self._counted(value)
        return value.encode("latin1") if isinstance(value, str) else bytes(value)

    def _scalar(self, dtype: _DType, data: object) -> Any:
        return self._array((), dtype, self._bytes(data), False).item()

    def _from_buffer(self, data: object, dtype: _DType, shape: tuple[int, ...], order: str) -> Any:
        return self._array(shape, dtype, self._bytes(data), order == "F")

    def _array(self, shape: Any, dtype: Any, data: Any, fortran: Any) -> Any:
        """The array, if the file holds as many bytes as it claims; of objects a list."""
        if not isinstance(dtype, _DType) or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise self._refused(f"an array of shape {shape!r} and dtype {dtype!r}")
        if isinstance(data, list):
            return list(self._counted(data))
        data = self._bytes(data)
        claimed = math.prod(shape) * dtype.numpy.itemsize
        if claimed != len(data) or dtype.code[0] == "O":
            raise MotionError(
                f"{self.path}: an array of shape {tuple(shape)} and dtype {dtype.code} claims {claimed} bytes, "
                f"the file holds {len(data)}"
            )
        return np.frombuffer(data, dtype.numpy).reshape(shape, order="F" if fortran else "C")

    def _keys(self, items: Any) -> Any:
        # nested tuples can be made to take forever to hash
        if bad := next((item for item in items if not isinstance(item, _KEYS)), None):
            raise self._refused(f"a {type(bad).__name__} as a key")
        return items

    def _pairs(self, pairs: Any = ()) -> dict[Any, Any]:
        return self._dict([item for key, value in self._counted(pairs) for item in (key, value)])

    def _dict(self, items: list[Any]) -> dict[Any, Any]:
        return dict(zip(self._keys(items[::2]), items[1::2], strict=True))

    # -- the stack -------------------------------------------------------------------------------------------

    def _to_mark(self) -> list[Any]:
        at = max(i for i, value in enumerate(self.stack) if value is _MARK) if self.stack else 0
        items = self.stack[at + 1 :]
        del self.stack[at:]
        return items

    def _op_mark(self, _: Any) -> None:
        self.stack.append(_MARK)

    def _op_pop(self, _: Any) -> None:
        self.stack.pop()

    def _op_pop_mark(self, _: Any) -> None:
        self._to_mark()

    def _op_dup(self, _: Any) -> None:
        self.stack.append(self.stack[-1])

    def _op_put(self, key: int) -> None:
        value = self.memo[key] = self.stack[-1]
        if isinstance(value, _Array):
            value.memo_keys.append(key)

    _op_binput = _op_long_binput = _op_put

    def _op_memoize(self, _: Any) -> None:
        self._op_put(len(self.memo))

    def _op_get(self, key: int) -> None:
        self.stack.append(self.memo[key])

    _op_binget = _op_long_binget = _op_get

    # -- containers ------------------------------------------------------------------------------------------

    def _op_none(self, _: Any) -> None:
        self.stack.append(None)

    def _op_newtrue(self, _: Any) -> None:
        self.stack.append(True)

    def _op_newfalse(self, _: Any) -> None:
        self.stack.append(False)

    def _op_empty_list(self, _: Any) -> None:
        self.stack.append([])

    def _op_list(self, _: Any) -> None:
        self.stack.append(self._to_mark())

    def _op_append(self, _: Any) -> None:
        self._extend([self.stack.pop()])

    def _op_appends(self, _: Any) -> None:
        self._extend(self._to_mark())

    def _extend(self, items: list[Any]) -> None:
        if not isinstance(self.stack[-1], list):
            raise self._refused(f"to append to a {type(self.stack[-1]).__name__}")
        self.stack[-1].extend(items)

    def _op_empty_tuple(self, _: Any) -> None:
        self.stack.append(())

    def _op_tuple(self, _: Any) -> None:
        self.stack.append(tuple(self._to_mark()))

    def _last(self, count: int) -> None:
        self.stack[-count:] = [tuple(self.stack[-count:])]

    def _op_tuple1(self, _: Any) -> None:
        self._last(1)

    def _op_tuple2(self, _: Any) -> None:
        self._last(2)

    def _op_tuple3(self, _: Any) -> None:
        self._last(3)

    def _op_empty_set(self, _: Any) -> None:
        self.stack.append(set())

    def _op_additems(self, _: Any) -> None:
        items = self._to_mark()
        self.stack[-1].update(self._keys(items))

    def _op_frozenset(self, _: Any) -> None:
        self.stack.append(frozenset(self._keys(self._to_mark())))

    def _op_empty_dict(self, _: Any) -> None:
        self.stack.append({})

    def _op_dict(self, _: Any) -> None:
        self.stack.append(self._dict(self._to_mark()))

    def _op_setitem(self, _: Any) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._update([key, value])

    def _op_setitems(self, _: Any) -> None:
        self._update(self._to_mark())

    def _update(self, items: list[Any]) -> None:
        if not isinstance(self.stack[-1], dict):
            raise self._refused(f"to set items of a {type(self.stack[-1]).__name__}")
        self.stack[-1].update(self._dict(items))

    # -- names and what is made with them -------------------------------------------------------------------

    def _op_global(self, argument: str) -> None:
        module, _, name = argument.partition(" ")
        full = f"{module}.{name}"
        if full not in self.calls and full not in ("numpy.ndarray", _JOBLIB_ARRAY):
            raise self._refused(full)
        self.stack.append(_Name(full))

    def _op_stack_global(self, _: Any) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self._op_global(f"{module} {name}")

    def _op_reduce(self, _: Any) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        name = function.name if isinstance(function, _Name) else type(function).__name__
        if name not in self.calls or not isinstance(arguments, tuple):
            raise self._refused(f"to call {name}")
        self.stack.append(self.calls[name](*arguments))

    def _op_newobj(self, _: Any) -> None:
        _, cls = self.stack.pop(), self.stack.pop()
        name = cls.name if isinstance(cls, _Name) else type(cls).__name__
        if name != _JOBLIB_ARRAY:
            raise self._refused(f"a new {name}")
        self.stack.append(_Array(wrapped=True))

    def _op_build(self, _: Any) -> None:
        state, thing = self.stack.pop(), self.stack[-1]
        if isinstance(thing, _DType) and isinstance(state, tuple):
            self._build_dtype(thing, *state[1:5])
        elif isinstance(thing, _Array):
            if thing.wrapped:
                array = self._inline(state)
            else:
                shape, dtype, fortran, content = state[-4:]
                array = self._array(shape, dtype, content, fortran)
            self.stack[-1] = array
            for key in thing.memo_keys:
                self.memo[key] = array
        else:
            raise self._refused(f"to fill a {type(thing).__name__}")

    def _build_dtype(self, dtype: _DType, order: str, sub: object, names: object, fields: object) -> None:
        if order not in ("<", ">", "|", "=") or not (sub is names is fields is None):
            raise self._refused(f"a structured dtype {names!r}")
        dtype.order = "=" if order == "|" else order

    def _inline(self, state: dict[str, Any]) -> Any:
        """What joblib wrote right behind the description of an array: padding, then the bytes; of objects a pickle."""
        shape, dtype = state["shape"], state["dtype"]
        if dtype.code[0] == "O":
            return _Machine(self.path, self.file, self.size).run()
        if state.get("numpy_array_alignment_bytes") is not None:
            self.file.seek(self.file.read(1)[0], io.SEEK_CUR)
        claimed = math.prod(shape) * dtype.numpy.itemsize
        return self._array(shape, dtype, self.file.read(min(claimed, self.size)), state.get("order") == "F")


_CONSTANTS = {
    f"{size}{kind}"
    for kind, sizes in {
        "INT": ("", "BIN"),
        "LONG": ("",),
        "FLOAT": ("", "BIN"),
        "STRING": ("", "BIN", "SHORT_BIN"),
        "BYTES": ("BIN", "SHORT_BIN"),
        "UNICODE": ("", "BIN", "SHORT_BIN"),
    }.items()
    for size in sizes
} | {"BININT1", "BININT2", "LONG1", "LONG4", "BINBYTES8", "BYTEARRAY8", "BINUNICODE8"}
