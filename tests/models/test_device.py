"""The device is asked for in one word; what is not there is said, never silently replaced."""

import pytest
import torch

from hoidata.errors import BadInput, MissingResource
from models.common.repeatable import chosen_device


@pytest.mark.parametrize("present", [True, False])
def test_auto_takes_a_gpu_where_there_is_one(monkeypatch, present: bool):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: present)
    assert chosen_device("auto") == ("cuda" if present else "cpu")
    assert chosen_device("cpu") == "cpu"


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert chosen_device("cuda") == "cuda"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingResource, match="set it to auto or cpu"):
        chosen_device("cuda")


def test_another_word_is_refused():
    with pytest.raises(BadInput, match="auto or cpu or cuda"):
        chosen_device("gpu")
