"""Tensors over memory that must not be written."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from caraware.ipc.channel import ReadOnlyTensor, read_only_tensor


def lent() -> np.ndarray:
    """f32 `[3, 2]`, not writable."""
    return np.frombuffer(np.arange(6, dtype=np.float32).tobytes(), np.float32).reshape(3, 2)


def test_its_array_is_the_one_that_it_lies_over_and_cannot_be_written() -> None:
    array = lent()
    tensor = read_only_tensor(array)
    assert tensor.numpy() is array
    with pytest.raises(ValueError, match="read-only"):
        tensor.numpy()[0, 0] = 1.0


def test_a_view_has_the_array_and_the_length_of_its_own_rows() -> None:
    tensor = read_only_tensor(lent())
    view = tensor[1:]
    assert isinstance(view, ReadOnlyTensor)
    assert (len(tensor), len(view), len(tensor[0]), len(tensor.t())) == (3, 2, 2, 2)
    assert view.numpy().tolist() == [[2.0, 3.0], [4.0, 5.0]]
    assert tensor.t().numpy().tolist() == [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]


def test_results_are_ordinary_tensors_and_writes_raise() -> None:
    tensor = read_only_tensor(lent())
    for result in (tensor + 1, tensor.clone(), torch.cat((tensor, tensor))):
        assert type(result) is torch.Tensor
        result.add_(1)
    writes: list[Callable[[], object]] = [
        lambda: tensor.add_(1),
        lambda: tensor[1:].zero_(),
        lambda: torch.add(tensor, 1, out=tensor),
    ]
    for write in writes:
        with pytest.raises(RuntimeError, match="read-only"):
            write()
