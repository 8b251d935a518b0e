"""The compared methods: names and what they change."""

import dataclasses
import math

import pytest

from comparison.methods import METHOD_FIELDS, Method
from tasks.settings import SETTINGS


@pytest.mark.parametrize(
    ("name", "method", "family", "label"),
    [
        ("ppo", Method(), "ppo", "PPO"),
        ("loss-0.1", Method("ppo", 0.1), "loss", "PPO + loss-0.1"),
        ("aug-random", Method("aug-random"), "aug", "PPO + aug. (random)"),
        ("aug-naive-raw", Method("aug-naive-raw"), "aug-naive", "naive aug., unprotected"),
        ("aug+loss-0.1+init-4", Method("aug", 0.1, 4.0), "aug", "PPO + aug. + loss-0.1, init-4"),
        ("equivariant", Method("equivariant"), "equivariant", "equivariant PPO"),
        ("relaxed+loss-1", Method("relaxed", 1.0), "relaxed", "relaxed PPO + loss-1"),
        ("ppo+symmetric-init", Method("ppo", 0.0, 1.0, "symmetric"), "ppo", "PPO, symmetric init"),
        (
            "aug+symmetric-init+init-4",
            Method("aug", 0.0, 4.0, "symmetric"),
            "aug",
            "PPO + aug., symmetric init-4",
        ),
    ],
)
def test_a_method_is_a_sum_of_parts(name, method, family, label):
    parsed = Method.parse(name)
    assert (parsed, parsed.name, parsed.family, parsed.label) == (method, name, family, label)
    turned = Method.parse("+".join(reversed(name.split("+"))))
    assert turned == method and hash(turned) == hash(method), "in any order"


@pytest.mark.parametrize(
    "name",
    [
        "augment",
        "loss-",
        "loss-x",
        "loss-inf",
        "init-0",
        "init-nan",
        "aug+",
        "init",
        "loss--1",
        "init-init",
    ],
)
def test_an_unknown_part_is_named(name):
    with pytest.raises(ValueError, match="expected a method made of"):
        Method.parse(name)


@pytest.mark.parametrize(
    "name",
    ["aug+ppo", "loss-1+loss-2", "aug+init-2+init-2", "aug+equivariant", "symmetric-init+symmetric-init"],
)
def test_a_method_has_one_part_of_a_kind(name):
    with pytest.raises(ValueError, match="expected at most one"):
        Method.parse(name)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("equivariant+symmetric-init", "no symmetric-init beside equivariant"),
        ("relaxed+init-4+symmetric-init", "no symmetric-init beside relaxed"),
        ("equivariant+loss-1", "no mirror loss beside equivariant, where it is always zero"),
    ],
)
def test_a_part_without_effect_is_refused(name, complaint):
    with pytest.raises(ValueError, match=f"expected {complaint}"):
        Method.parse(name)


def test_methods_change_the_settings():
    config = Method.parse("aug-naive-raw").configure(SETTINGS["cartpole"], seed=3).config
    assert (config.augmentation, config.max_log_ratio, config.max_std) == ("naive", math.inf, math.inf)
    assert config.seed == 3
    config = Method.parse("loss-10").configure(SETTINGS["cartpole"], 0, num_envs=64).config
    assert (config.augmentation, config.mirror_coeff, config.num_envs) == ("none", 10.0, 64)
    scaled = Method.parse("aug+init-4").configure(SETTINGS["cartpole"], 0).config
    assert (scaled.augmentation, scaled.weight_scale) == ("all", 4.0)


def test_networks_and_initial_weights_are_changes_of_the_configuration():
    ordinary = {"augmentation": "all", "mirror_coeff": 0.0, "weight_scale": 4.0}
    assert Method.parse("aug+init-4").changes == ordinary, "nothing that is the default"
    assert Method.parse("aug+symmetric-init+init-4").changes == ordinary | {"initialization": "symmetric"}
    for network in ("equivariant", "relaxed"):
        changes = Method.parse(network).changes
        assert (changes["network"], changes["augmentation"]) == (network, "none")
        assert changes.keys() <= METHOD_FIELDS, "not for --config to change"


def test_all_members_of_a_family_share_what_was_tuned():
    setting = dataclasses.replace(SETTINGS["cartpole"], tuned={"aug": {"gamma": 0.5}})
    gamma = {
        name: Method.parse(name).configure(setting, 0).config.gamma
        for name in ("aug", "aug-random", "aug+loss-1", "ppo", "aug-naive")
    }
    default = SETTINGS["cartpole"].config.gamma
    expected = {"aug": 0.5, "aug-random": 0.5, "aug+loss-1": 0.5, "ppo": default, "aug-naive": default}
    assert gamma == expected


def test_steps_shorten_all_stages_alike():
    setting = SETTINGS["anymal_push"]
    half = Method.parse("ppo").configure(setting, 0, steps=setting.frames // 2)
    whole = [stage.config.iterations for stage in setting.stages]
    assert [stage.config.iterations for stage in half.stages] == [count // 2 for count in whole]
    assert half.frames == setting.frames // 2
    assert {stage.config.augmentation for stage in half.stages} == {"none"}
