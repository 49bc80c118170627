"""Tensors are read without unpickling, and none takes all memory."""

import io
import zipfile

import numpy as np
import pytest
import torch

from rlctl.importing import tensor_file
from rlctl.importing.pickle_data import NotPlainData
from rlctl.importing.tensor_file import read_tensors


def save(state, *, as_archive=True):
    buffer = io.BytesIO()
    torch.save(state, buffer, _use_new_zipfile_serialization=as_archive)
    return buffer.getvalue()


@pytest.mark.parametrize("as_archive", [True, False])  # torch before 1.6 wrote no archives
def test_tensors_of_both_forms(as_archive):
    shared = torch.arange(12.0)
    state = {
        "whole": shared, "part": shared[3:7], "turned": shared.reshape(3, 4).T, "parameter": torch.nn.Parameter(shared),
        "counts": torch.tensor([1, 2]), "flags": torch.tensor([True, False]), "double": torch.tensor(0.5).double(),
        "empty": torch.zeros(0, 3),
    }  # fmt: skip
    read = read_tensors(save(state, as_archive=as_archive))
    assert list(read) == list(state)
    for name, tensor in state.items():
        expected = tensor.detach().numpy()
        assert read[name].dtype == expected.dtype
        np.testing.assert_array_equal(read[name], expected)


def test_damaged_older_form():
    content = save({"a": torch.ones(4), "b": torch.ones(2)}, as_archive=False)
    for length in range(0, len(content), 7):
        with pytest.raises((NotPlainData, ValueError, KeyError, TypeError)):
            read_tensors(content[:length])
    changed = content.replace(b"\x04\0\0\0\0\0\0\0", b"\xff" * 8)  # the count of numbers in a storage
    assert changed != content
    with pytest.raises(NotPlainData, match="ends early"):
        read_tensors(changed)


def test_tensors_cannot_reach_out_of_their_storage():
    buffer = io.BytesIO()
    torch.save({"a": torch.arange(6.0).reshape(2, 3).T}, buffer)
    np.testing.assert_array_equal(read_tensors(buffer.getvalue())["a"], np.arange(6.0).reshape(2, 3).T)
    with zipfile.ZipFile(buffer) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = next(each for each in members if each.endswith("data/0"))
    members[name] = members[name][:8]
    short = io.BytesIO()
    with zipfile.ZipFile(short, "w") as archive:
        for each, content in members.items():
            archive.writestr(each, content)
    with pytest.raises(NotPlainData, match="reads outside its storage"):
        read_tensors(short.getvalue())


def test_tensors_cannot_repeat_their_storage_without_end(monkeypatch):
    repeated = torch.ones(1).expand(1_000_000, 1_000_000)
    with pytest.raises(NotPlainData, match="larger than its storage"):
        read_tensors(save({"a": repeated}))
    shared = torch.ones(100)
    content = save({str(number): shared for number in range(11)})
    assert len(read_tensors(content)) == 11
    monkeypatch.setattr(tensor_file, "LARGEST_MEMBER", 4_000)
    with pytest.raises(NotPlainData, match="more than 4,000 bytes"):
        read_tensors(content)
