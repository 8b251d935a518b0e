"""rsl_rl with the bridge: its own PPO, update for update, beside a function written by hand."""

import itertools
import sys
import types

import pytest
import torch
from tensordict import TensorDict

from tests.point_groups import random
from torchrl_sym import Exchanged, PointGroup, Symmetry
from torchrl_sym.bridges.rsl_rl import data_augmentation
from torchrl_sym.representations import (
    axial,
    height_map,
    image,
    invariant,
    items,
    permutation,
    planar,
    polar,
    pseudoscalar,
    signed_permutation,
)

K4, MIRROR = PointGroup.klein_four(), PointGroup.reflection("y")
LEGS = ["FR", "FL", "RR", "RL"]
SIDES = {"reflect-y": ["FL", "FR", "RL", "RR"], "reflect-x": ["RR", "RL", "FR", "FL"]}  # images of the legs
FLIPPED = {"reflect-y": {"hip": "-"}, "reflect-x": {"thigh": "-", "calf": "-"}}
FRAMES, NUM_ENVS, STEPS = 3, 6, 4


def locomotion(group: PointGroup) -> Symmetry:
    """A quadruped that sees three frames of most terms, oldest first; a critic; a scan of heights."""
    images = {g: dict(zip(LEGS, to, strict=True)) for g, to in SIDES.items() if g in group.names}
    joints = [(leg, joint) for leg in LEGS for joint in ("hip", "thigh", "calf")]
    legs = signed_permutation(
        group,
        [f"{leg}_{joint}" for leg, joint in joints],
        {
            g: {f"{leg}_{j}": FLIPPED[g].get(j, "") + f"{to[leg]}_{j}" for leg, j in joints}
            for g, to in images.items()
        },
    )
    feet, lines = permutation(group, LEGS, images), torch.linspace(-0.4, 0.4, 5)
    return Symmetry(
        group,
        {
            "policy": axial(group) * FRAMES + planar(group) + pseudoscalar(group) + legs * FRAMES + legs,
            "critic": polar(group) + items(feet, polar(group)).flatten() + feet,
            "height_scan": height_map(group, lines, lines[1:4], order="xy"),
            "action": legs,
        },
    )


# The same by hand, in the way of Isaac Lab's functions: indices and signs.

ORDER = {"reflect-x": [2, 3, 0, 1], "reflect-y": [1, 0, 3, 2], "rot-180": [3, 2, 1, 0]}
SIGNS = {"reflect-x": [1.0, -1.0, -1.0], "reflect-y": [-1.0, 1.0, 1.0], "rot-180": [-1.0, -1.0, -1.0]}
POLAR = {"reflect-x": [-1.0, 1.0, 1.0], "reflect-y": [1.0, -1.0, 1.0], "rot-180": [-1.0, -1.0, 1.0]}
AXIAL = {"reflect-x": [1.0, -1.0, -1.0], "reflect-y": [-1.0, 1.0, -1.0], "rot-180": [-1.0, -1.0, 1.0]}
COMMAND = {"reflect-x": [-1.0, 1.0, -1.0], "reflect-y": [1.0, -1.0, -1.0], "rot-180": [-1.0, -1.0, 1.0]}
FLIPS = {"reflect-x": [2], "reflect-y": [1], "rot-180": [1, 2]}


def joints_by_hand(x: torch.Tensor, g: str) -> torch.Tensor:
    return (x.view(-1, 4, 3)[:, ORDER[g]] * torch.tensor(SIGNS[g])).flatten(1)


def by_hand(group: PointGroup, whole: bool = True):
    """A function as rsl_rl calls it; not ``whole``: only the policy's group, as many of them do."""

    def policy(x: torch.Tensor, g: str) -> torch.Tensor:
        angular = x[:, :9].view(-1, FRAMES, 3) * torch.tensor(AXIAL[g])
        joints = [joints_by_hand(x[:, i : i + 12], g) for i in range(12, 60, 12)]
        return torch.cat([angular.flatten(1), x[:, 9:12] * torch.tensor(COMMAND[g]), *joints], -1)

    def critic(x: torch.Tensor, g: str) -> torch.Tensor:
        forces = x[:, 3:15].view(-1, 4, 3)[:, ORDER[g]] * torch.tensor(POLAR[g])
        return torch.cat([x[:, :3] * torch.tensor(POLAR[g]), forces.flatten(1), x[:, 15:][:, ORDER[g]]], -1)

    def function(env, obs, actions):
        if obs is not None:
            copies = [obs]
            for g in group.names[1:]:
                copies.append(obs.clone())
                copies[-1]["policy"] = policy(obs["policy"], g)
                if whole:
                    copies[-1]["critic"] = critic(obs["critic"], g)
                    heights = obs["height_scan"].view(-1, 3, 5).flip(FLIPS[g])
                    copies[-1]["height_scan"] = heights.flatten(1)
            obs = torch.cat(copies)
        if actions is not None:
            actions = torch.cat([actions, *(joints_by_hand(actions, g) for g in group.names[1:])])
        return obs, actions

    return function


def observations(seed: int, num: int = NUM_ENVS) -> TensorDict:
    sizes = {"policy": 60, "critic": 19, "height_scan": 15}
    td = {name: random(num, d, seed=10 * seed + d, dtype=torch.float32) for name, d in sizes.items()}
    return TensorDict(td, batch_size=[num])


def updated(function, **settings) -> tuple[dict[str, torch.Tensor], dict[str, float]]:
    """Parameters and losses after one whole update of rsl_rl's PPO."""
    algorithms = pytest.importorskip("rsl_rl.algorithms", reason="pip install rsl-rl-lib")

    class Env:
        num_envs, num_actions = NUM_ENVS, 12

    torch.manual_seed(0)
    network = {"class_name": "MLPModel", "hidden_dims": [32], "obs_normalization": True}
    normal = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    cfg = {
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 2,
            "num_mini_batches": 3,
            "symmetry_cfg": {"data_augmentation_func": function} | settings,
        },
        "actor": network | {"distribution_cfg": normal},
        "critic": dict(network),
        "obs_groups": {"actor": ["policy", "height_scan"], "critic": ["policy", "critic", "height_scan"]},
        "num_steps_per_env": STEPS,
        "multi_gpu": None,
    }
    ppo = algorithms.PPO.construct_algorithm(observations(0), Env(), cfg, "cpu")
    ppo.train_mode()
    with torch.inference_mode():
        for step in range(STEPS):
            ppo.act(observations(step))
            reward = random(NUM_ENVS, seed=step, dtype=torch.float32)
            ppo.process_env_step(observations(step + 1), reward, reward > 1, {})
        ppo.compute_returns(observations(STEPS))
    losses = ppo.update()
    state = ppo.save()
    return state["actor_state_dict"] | {f"v.{k}": v for k, v in state["critic_state_dict"].items()}, losses


MODES = {
    "augmentation": {"use_data_augmentation": True},
    "mirror loss": {"use_mirror_loss": True, "mirror_loss_coeff": 0.5},
    "both": {"use_data_augmentation": True, "use_mirror_loss": True, "mirror_loss_coeff": 0.5},
    "only logged": {},
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("group", [MIRROR, K4], ids=["mirror", "K4"])
def test_an_update_equals_one_with_a_function_by_hand_bit_for_bit(group, mode):
    weights, losses = updated(data_augmentation(locomotion(group)), **MODES[mode])
    expected, expected_losses = updated(by_hand(group), **MODES[mode])
    assert losses == expected_losses
    assert weights.keys() == expected.keys()
    assert all(torch.equal(weights[name], expected[name]) for name in expected)


def test_a_critic_that_stays_as_it_is_gives_another_update():
    """What the functions in circulation do in silence; so the test above can tell."""
    weights, _ = updated(data_augmentation(locomotion(MIRROR)), **MODES["augmentation"])
    wrong, _ = updated(by_hand(MIRROR, whole=False), **MODES["augmentation"])
    assert not torch.equal(weights["v.mlp.0.weight"], wrong["v.mlp.0.weight"])


def test_a_function_is_found_by_name(monkeypatch):
    utils = pytest.importorskip("rsl_rl.utils", reason="pip install rsl-rl-lib")
    module = types.ModuleType("my_task")
    module.augment = AUGMENT
    monkeypatch.setitem(sys.modules, "my_task", module)
    assert utils.resolve_callable("my_task:augment") is AUGMENT


AUGMENT = data_augmentation(locomotion(K4))


# The contract, without rsl_rl.


def test_originals_come_first_and_copies_by_element():
    obs, actions = observations(1), random(NUM_ENVS, 12, dtype=torch.float32)
    images, mapped = AUGMENT(env=None, obs=obs, actions=actions)
    assert images.batch_size == (4 * NUM_ENVS,) and mapped.shape == (4 * NUM_ENVS, 12)
    expected, expected_actions = by_hand(K4)(None, obs, actions)
    assert (images == expected).all() and torch.equal(mapped, expected_actions)
    assert (images[:NUM_ENVS] == obs).all() and (obs == observations(1)).all()


def test_either_may_be_missing():
    obs, actions = observations(1), random(NUM_ENVS, 12)
    assert AUGMENT(env=None, obs=obs, actions=None)[1] is None
    assert AUGMENT(env=None, obs=None, actions=actions)[0] is None
    assert AUGMENT(env=None, obs=None, actions=None) == (None, None)


def test_gradients_pass_through():
    actions = random(NUM_ENVS, 12).requires_grad_()
    AUGMENT(env=None, obs=None, actions=actions)[1].square().sum().backward()
    torch.testing.assert_close(actions.grad, 8 * actions)


def test_groups_of_terms_images_and_unflattened_histories_are_mapped():
    joints = locomotion(K4)["action"]
    symmetry = Symmetry(
        K4,
        {
            ("policy", "gravity"): polar(K4),
            ("policy", "joints"): items(invariant(K4, FRAMES), joints),
            "camera": image(K4, (1, 4, 4), "CHW"),
            "action": joints,
        },
    )
    obs = TensorDict(
        policy=TensorDict(gravity=random(5, 3), joints=random(5, FRAMES, 12), batch_size=[5]),
        camera=random(5, 1, 4, 4),
        batch_size=[5],
    )
    images, _ = data_augmentation(symmetry)(None, obs, None)
    for g, part in zip(range(4), images.split(5), strict=True):
        assert (part == symmetry(obs, g)).all()


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize("name", ["privileged", "hash", "mask", "next", "collector"])
def test_an_undeclared_group_is_refused_whatever_its_name(name, strict):
    symmetry = locomotion(MIRROR)
    symmetry.strict = strict
    obs = observations(0).set(name, random(NUM_ENVS, 1))
    with pytest.raises(KeyError, match=f"have .*{name}.*does not transform"):
        data_augmentation(symmetry)(None, obs, None)


def test_hands_under_two_keys_change_places():
    hands = permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
    declared = {Exchanged("left", "right"): items(hands, polar(MIRROR)), "action": polar(MIRROR)}
    obs = TensorDict(left=random(2, 3, seed=1), right=random(2, 3, seed=2), batch_size=[2])
    images, _ = data_augmentation(Symmetry(MIRROR, declared))(None, obs, None)
    assert torch.equal(images["left"][2:], obs["right"] * torch.tensor([1.0, -1.0, 1.0]))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda obs, actions: (obs["policy"], actions), TypeError, "expected a tensordict"),
        (lambda obs, actions: (obs.set("critic", obs["policy"]), actions), ValueError, "entry 'critic'"),
        (lambda obs, actions: (obs, actions[:, :11]), ValueError, "last dimension of 12"),
        (lambda obs, actions: (obs, actions.tolist()), TypeError, "expected a tensor"),
    ],
)
def test_what_does_not_fit_is_refused(change, error, message):
    with pytest.raises(error, match=message):
        AUGMENT(None, *change(observations(0), random(NUM_ENVS, 12)))


def test_an_action_that_is_not_declared_is_refused():
    with pytest.raises(KeyError, match="no representation for 'action'"):
        data_augmentation(Symmetry(MIRROR, {"policy": polar(MIRROR)}))
    with pytest.raises(KeyError, match="no representation for 'torque'"):
        data_augmentation(locomotion(MIRROR), action_key="torque")
    assert callable(data_augmentation(locomotion(MIRROR), action_key=("action",)))


def test_copies_of_copies_are_the_group():
    """The function is an action of the group: a second round only changes the order of the copies."""
    obs, _ = AUGMENT(None, observations(2, num=1), None)
    twice, _ = AUGMENT(None, obs, None)
    for g, h in itertools.product(range(4), repeat=2):
        assert (twice[4 * g + h] == obs[int(K4.table[g, h])]).all()
