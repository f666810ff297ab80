"""From NumPy to the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

#: Bytes to which Dr.Jit aligns its own memory.
ALIGNMENT = 64


def uploaded(kind: type, values: np.ndarray, beyond: int = 0) -> Any:
    """A flat Dr.Jit array of type `kind` (32-bit indices, floats or masks) with these values.

    On the CPU, Dr.Jit adopts NumPy's memory and compiles other kernels if it does not happen to be aligned.

    `beyond`: how many times the last value stands behind the array, for who reads past its end; on the CPU alone.
    """
    values = np.asarray(values, _numpy_type(kind))
    room = np.append(values.ravel(), np.repeat(values.ravel()[-1:], beyond)) if beyond else values.ravel()
    memory = np.empty(room.nbytes + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    aligned = memory[start : start + room.nbytes].view(values.dtype)
    aligned[:] = room
    return kind(aligned[: values.size])


def _numpy_type(kind: type) -> Any:
    if dr.is_mask_v(kind):
        return np.bool_
    if dr.is_float_v(kind):
        return np.float64 if dr.type_v(kind) == dr.VarType.Float64 else np.float32
    return np.uint32


def in_memory(value):
    """`value`, a parameter to be, evaluated and written.

    Mitsuba 3.9.1 waits for kernels that read a parameter, then evaluates the new one and looks at its memory at once
    (`sdfgrid`): it would find what was there before, and crash.
    """
    dr.eval(value)
    dr.sync_thread()
    return value
