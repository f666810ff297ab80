"""Scene parameters by value: what differs from the scene's file, on its way to a worker and into the scene there."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np

from psdr_jit.core.upload import in_memory, uploaded
from psdr_jit.scene.params import is_transform, parameter_value

Values = dict[str, np.ndarray]


def to_numpy(value: Any) -> np.ndarray | None:
    """The numbers of a parameter; None for what carries none."""
    if is_transform(value):
        matrix = np.array(dr.detach(value.matrix)) if dr.is_array_v(value.matrix) else None
        return None if matrix is None or matrix.size != np.prod(matrix.shape[:2]) else matrix.reshape(matrix.shape[:2])
    return np.array(dr.detach(value)) if dr.is_array_v(value) else None


def from_numpy(like: Any, numbers: np.ndarray) -> Any:
    """A parameter of the type of `like`. Its memory is its own: what arrives by network is not aligned."""
    kind = type(like)
    if is_transform(like):
        value = kind(np.array(numbers))
    elif dr.is_tensor_v(like):
        value = kind(uploaded(dr.array_t(kind), numbers), numbers.shape)
    elif dr.depth_v(like) > 1:
        value = kind(*(uploaded(dr.leaf_t(kind), row) for row in numbers))
    else:
        value = uploaded(kind, numbers)
    return in_memory(value)


def digest_of(numbers: np.ndarray) -> bytes:
    return hashlib.sha256(repr((numbers.shape, numbers.dtype.str)).encode() + numbers.tobytes()).digest()


def digests(params: Any) -> dict[str, bytes]:
    """Of every parameter that has numbers."""
    numbers = {name: to_numpy(parameter_value(params, name)) for name in params.keys()}
    return {name: digest_of(found) for name, found in numbers.items() if found is not None}


def changed(params: Any, before: Mapping[str, bytes]) -> Values:
    """Parameters whose numbers are not those that `before` was made from."""
    found = {}
    for name in before:
        numbers = to_numpy(parameter_value(params, name))
        if numbers is not None and digest_of(numbers) != before[name]:
            found[name] = numbers
    return found
