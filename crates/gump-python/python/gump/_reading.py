"""Files and messages as scenarios."""

from __future__ import annotations

import os
from typing import Union

from . import _native


def open(path: Union[str, "os.PathLike[str]"]) -> _native.Reader:
    """Iterates over the scenarios of a file or folder, whatever its format.

    Reads Waymo's Open Motion Dataset, nuPlan, Argoverse 2, GPUDrive and Nocturne, CommonRoad, SUMO,
    TAF-BW, gump's own cache and JSON; which one it is shows in the content. One scenario is in
    memory at a time. The reader is a context manager, too.

    Raises `FileNotFoundError`, and `DataError` for what holds no scenarios; while iterating
    `DataError` for a damaged record, after which `next()` goes on, and `ValueError` once it is
    closed.
    """
    return _native.Reader(os.fspath(path))


def read(message: bytes) -> _native.Scenario:
    """The scenario of a serialized `waymo.open_dataset.Scenario` message.

    Raises `DataError` for bytes that are none, and for a scenario that breaks a promise of its
    format.
    """
    if not isinstance(message, (bytes, bytearray, memoryview)):
        raise TypeError(f"message: expected bytes, found {type(message).__name__}")
    return _native.read(bytes(message))
