"""Where what is observed comes from: flags, random numbers, wrappers of another library."""

import functools

import pytest
import torch
from torchrl.data import Binary, OneHot, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    GymWrapper,
    SerialEnv,
    TensorDictPrimer,
    TransformedEnv,
    VecNormV2,
)

from tests.test_probing import BODY, GROUP, KNEES, Robot, norm, robot
from torchrl_sym import Symmetry
from torchrl_sym.representations import polar, scalar


def test_flags_are_followed_although_any_two_may_be_equal():
    flags = {"contacts": torch.bool, "mode": torch.int64}

    class Feet(Robot):
        def __init__(self):
            super().__init__(apart=True)
            self.observation_spec["contacts"] = Binary(8, (2, 8), dtype=torch.bool)
            self.observation_spec["mode"] = OneHot(3, (2, 3), dtype=torch.int64)

    def feet(*transforms):
        casts = [DTypeCastTransform(dtype, torch.float64, in_keys=[key]) for key, dtype in flags.items()]
        keys = ["velocity", "knees", "contacts", "mode"]
        cat = CatTensors(in_keys=keys, out_key="observation", sort=False)
        return TransformedEnv(Feet(), Compose(*casts, *transforms, cat))

    symmetry = Symmetry(GROUP, {"observation": BODY + KNEES * 4 + scalar(GROUP) * 3, "action": KNEES})
    symmetry.check_specs(feet())
    with pytest.raises(ValueError, match="ObservationNorm does not commute"):
        symmetry.check_specs(feet(norm([0.0, 0.5] * 4, 1.0, "contacts")))


def test_what_is_made_of_random_numbers_is_not_taken_for_noise():
    symmetry = Symmetry(GROUP, {"observation": BODY, "goal": polar(GROUP), "action": KNEES})
    goal = functools.partial(TensorDictPrimer, goal=Unbounded((3,)), random=True, expand_specs=True)
    symmetry.check_specs(robot(goal()))
    with pytest.raises(ValueError, match=r"VecNormV2 keeps statistics of each entry of .*goal"):
        symmetry.check_specs(robot(goal(), VecNormV2(["goal"])))
    with pytest.warns(UserWarning, match="ObservationNorm cannot be tried out"):
        symmetry.check_specs(robot(goal(), norm([0, 0.1, 0], 1.0, "goal")))


def test_gymnasiums_own_normaliser():
    """Which is inside of what TorchRL calls the bare environment."""
    gym = pytest.importorskip("gymnasium")
    symmetry = Symmetry(GROUP, {"observation": scalar(GROUP) * 4, "action": scalar(GROUP) * 2})

    class Constant(gym.wrappers.NormalizeObservation):
        is_symmetric = True

    def made(wrapper):
        return TransformedEnv(GymWrapper(wrapper(gym.make("CartPole-v1"))), DoubleToFloat())

    symmetry.check_specs(made(gym.wrappers.NormalizeReward))
    symmetry.check_specs(made(Constant))
    normalised = functools.partial(made, gym.wrappers.NormalizeObservation)
    for env in (normalised(), SerialEnv(1, normalised)):
        with pytest.raises(ValueError, match=r"gymnasium's NormalizeObservation keeps statistics"):
            symmetry.check_specs(env)


def test_entries_without_dimensions_of_their_own():
    """As counters have, and sensors of one number: what is beside them is tried out all the same."""

    class Clock(Robot):
        def __init__(self):
            super().__init__()
            self.observation_spec["clock"] = Unbounded((2,))

    symmetry = Symmetry(GROUP, {"observation": BODY, "action": KNEES}, strict=False)
    symmetry.check_specs(TransformedEnv(Clock(), norm(0.0, 2.0)))
    with pytest.raises(ValueError, match="ObservationNorm does not commute"):
        symmetry.check_specs(TransformedEnv(Clock(), norm([0, 0.1, 0, 0, 0])))
