"""Constants of tasks: where the data is, in its precision, copied once, and by value."""

import copy
import pickle

import pytest
import torch

from tasks.constants import Constant


@pytest.mark.parametrize("device", ["cpu", "meta"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_constants_follow_the_data_and_are_copied_once(device, dtype):
    pose, data = Constant([0.1, 0.2]), torch.ones(3, 2, dtype=dtype, device=device)
    assert (data - pose.like(data)).dtype == dtype and pose.like(data).device == data.device
    assert pose.like(data) is pose.like(data + 1)
    assert pose.values.tolist() == [0.1, 0.2]


def test_copies_elsewhere_are_not_sent_along():
    pose = Constant([0.1, 0.2])
    pose.like(torch.ones(2, device="meta"))
    for twin in (pickle.loads(pickle.dumps(pose)), copy.deepcopy(pose)):
        assert torch.equal(twin.values, pose.values) and not twin._copies


def test_constants_are_their_own():
    numbers = torch.ones(2, dtype=torch.float64)
    pose = Constant(numbers)
    numbers[:] = 9.0
    assert pose.values.tolist() == [1.0, 1.0]
