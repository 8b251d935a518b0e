"""Whether an environment fits a symmetry: what `check_specs` refuses, and what it lets pass."""

import pytest
import torch
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, RewardSum, StepCounter, TransformedEnv, VecNormV2

import tasks
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.representations import planar, polar, pseudoscalar

REFLECTION = PointGroup.reflection("x")
SIGN = pseudoscalar(REFLECTION)


class Fields(EnvBase):
    """An environment that is nothing but its specs."""

    def __init__(self, action, **observations):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(**observations)
        self.action_spec = action
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        return self.observation_spec.zero()

    def _step(self, tensordict):
        return self.observation_spec.zero().update(
            {"reward": torch.zeros(1), "done": torch.zeros(1, dtype=bool)}
        )

    def _set_seed(self, seed):
        pass


def cartpole(*transforms):
    env = tasks.make_env("cartpole", num_envs=2, num_threads=1, seed=0)
    for transform in transforms:
        env = TransformedEnv(env, transform)
    return env


def test_running_normaliser_of_a_declared_observation_is_refused():
    symmetry = cartpole().symmetry
    symmetry.check_specs(cartpole(RewardSum(), StepCounter()))
    symmetry.check_specs(cartpole(VecNormV2(in_keys=["reward"])))
    with pytest.raises(ValueError, match=r"VecNormV2 does not commute .* of 'observation'"):
        symmetry.check_specs(cartpole(VecNormV2(in_keys=["observation"]), StepCounter()))


@pytest.mark.parametrize("leaf", ["loc", "scale"])
def test_observation_named_like_a_distribution_parameter_must_be_declared(leaf):
    env = Fields(Bounded(-1, 1, (1,)), **{leaf: Unbounded((1,))})
    with pytest.raises(KeyError, match=rf"the environment has \['{leaf}'\]"):
        Symmetry(REFLECTION, {"action": SIGN}).check_specs(env)
    assert leaf not in Symmetry(REFLECTION, {"action": SIGN})
    Symmetry(REFLECTION, {"action": SIGN, leaf: SIGN}).check_specs(env)


def test_boxes_of_turned_observations_are_not_checked_but_those_of_actions_are():
    group = PointGroup.rotation(3)
    gravity, push = Bounded(-1, 1, (3,)), Bounded(-1, 1, (2,))
    symmetry = Symmetry(group, {"gravity": polar(group), "action": planar(group)})
    symmetry.check_specs(Fields(Unbounded((2,)), gravity=gravity))
    with pytest.raises(ValueError, match="'action': the box of entry 0"):
        symmetry.check_specs(Fields(push, gravity=gravity))
