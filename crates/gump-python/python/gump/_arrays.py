"""Arrays of any library as contiguous NumPy arrays of one type."""

from __future__ import annotations

from typing import Any, Optional

import numpy as np

_NUMBERS = "fiu"


def _host(value: Any, name: str) -> np.ndarray:
    """The value as a NumPy array, without a copy where that is possible."""
    if isinstance(value, np.ndarray):
        return value
    if hasattr(value, "__dlpack__"):
        if getattr(value, "requires_grad", False):
            value = value.detach()
        try:
            return np.from_dlpack(value)
        except Exception as error:
            if not hasattr(value, "__array__"):
                raise TypeError(f"{name}: expected an array in main memory, found one that is not: {error}") from error
    try:
        return np.asarray(value)
    except Exception as error:
        raise TypeError(f"{name}: expected an array in main memory, found {type(value).__name__}: {error}") from error


def numbers(value: Any, name: str, dtype: Any = np.float32) -> np.ndarray:
    """A C-contiguous array of `dtype`; `TypeError` if it holds anything but real numbers."""
    found = _host(value, name)
    if found.dtype.kind not in _NUMBERS:
        raise TypeError(f"{name}: expected real numbers, found dtype {found.dtype}")
    return np.ascontiguousarray(found, dtype)


def ids(value: Any, name: str = "agent_id") -> np.ndarray:
    """Whole numbers as a C-contiguous int64 array."""
    found = _host(value, name)
    if found.size == 0:
        found = found.astype(np.int64)
    if found.dtype.kind == "f":
        if not np.isfinite(found).all() or (found != np.floor(found)).any():
            raise TypeError(f"{name}: expected whole numbers, found {found.dtype} that are not")
    elif found.dtype.kind not in "iu":
        raise TypeError(f"{name}: expected whole numbers, found dtype {found.dtype}")
    return np.ascontiguousarray(found, np.int64)


def optional(value: Any, name: str, dtype: Any = np.float32) -> Optional[np.ndarray]:
    """As `numbers`; `None` stays."""
    return None if value is None else numbers(value, name, dtype)
