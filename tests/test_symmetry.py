"""Symmetry of a tensordict: which entries are mapped, shared or refused, and the check of specs."""

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.point_groups import GROUPS, assert_close, random
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.representations import (
    invariant,
    items,
    planar,
    polar,
    pseudoscalar,
    signed_permutation,
)

every_symmetric_group = pytest.mark.parametrize("group", ["trivial", "reflect-y", "K4", "C3", "D3"])


def observation(group: PointGroup):
    return polar(group) + pseudoscalar(group)


def make_symmetry(group: str = "K4", strict: bool = True) -> Symmetry:
    g = GROUPS[group]
    return Symmetry(g, {"observation": observation(g), "action": planar(g)}, strict=strict)


def make_batch(*shape: int, dtype: torch.dtype = torch.float32, **extra: torch.Tensor) -> TensorDict:
    return TensorDict(
        {
            "observation": random(*shape, 4, seed=1, dtype=dtype),
            "action": random(*shape, 2, seed=2, dtype=dtype),
            "advantage": random(*shape, 1, seed=3, dtype=dtype),
            "next": {"observation": random(*shape, 4, seed=4, dtype=dtype), "done": torch.zeros(*shape, 1)},
            **extra,
        },
        batch_size=shape,
    )


def assert_same(actual: TensorDictBase, expected: TensorDictBase, atol: float = 0) -> None:
    assert actual.batch_size == expected.batch_size
    torch.testing.assert_close(actual.to_dict(), expected.to_dict(), rtol=0, atol=atol)


# --- one element, all elements, one element per row


@every_symmetric_group
def test_each_declared_entry_is_mapped_by_its_representation(group):
    symmetry, batch = make_symmetry(group), make_batch(5)
    for g, name in enumerate(GROUPS[group].names):
        image = symmetry(batch, name)
        assert_close(image["observation"], observation(GROUPS[group])(batch["observation"], g), atol=1e-6)
        assert_close(image["action"], planar(GROUPS[group])(batch["action"], g), atol=1e-6)


@every_symmetric_group
@pytest.mark.parametrize("shape", [(), (5,), (5, 3)], ids=str)
def test_orbit_stacks_the_images(group, shape):
    symmetry, batch = make_symmetry(group), make_batch(*shape)
    images = [symmetry(batch, g) for g in range(len(GROUPS[group]))]
    assert_same(symmetry.orbit(batch), torch.stack(images))


def test_orbit_of_chosen_elements():
    symmetry, batch = make_symmetry("D3"), make_batch(5)
    assert_same(symmetry.orbit(batch, [0, 4, 2]), torch.stack([symmetry(batch, g) for g in (0, 4, 2)]))


@every_symmetric_group
@pytest.mark.parametrize("shape", [(12,), (6, 4)], ids=str)
def test_each_row_is_mapped_by_its_own_element(group, shape):
    symmetry, batch = make_symmetry(group), make_batch(*shape)
    g = torch.arange(math.prod(shape)).reshape(shape) % len(GROUPS[group])
    image = symmetry(batch, g)
    for element in range(len(GROUPS[group])):
        rows = g == element
        assert_same(image[rows], symmetry(batch[rows], element), atol=1e-6)


def test_items_that_stay_in_place_are_mapped_one_by_one():
    per_agent = make_batch(6, 3)
    batch = per_agent.copy().auto_batch_size_(1)
    with pytest.raises(ValueError, match=r"expected event dimensions \(4,\), got \(3, 4\).*items"):
        make_symmetry()(batch, 1)
    group, single = GROUPS["K4"], make_symmetry()
    agents = {key: items(invariant(group, 3), single[key]) for key in single.keys()}  # noqa: SIM118
    g = torch.arange(6) % 4
    for image, row, element in zip(Symmetry(group, agents)(batch, g), per_agent, g, strict=True):
        assert_same(image.auto_batch_size_(1), single(row, int(element)))


@every_symmetric_group
def test_mapping_by_the_inverse_comes_back(group):
    symmetry, batch = make_symmetry(group), make_batch(5, dtype=torch.float64)
    for g, inverse in enumerate(GROUPS[group].inverse.tolist()):
        assert_same(symmetry(symmetry(batch, g), inverse), batch, atol=1e-12)


# --- keys


@pytest.mark.parametrize("key", ["observation", ("agents", "observation")], ids=str)
def test_next_follows_its_key(key):
    group = PointGroup.reflection("y")
    symmetry = Symmetry(group, {key: polar(group)})
    after = ("next", key) if isinstance(key, str) else ("next", *key)
    batch = TensorDict({key: random(5, 3), after: random(5, 3, seed=1)}, batch_size=[5])
    for entry in (key, after):
        assert torch.equal(symmetry(batch, 1)[entry], polar(group)(batch[entry], 1))
        assert entry in symmetry and symmetry[entry].dim == 3


SHARED = [
    *("reward", "done", "advantage", "value_target", "state_value", "step_count", "_weight"),
    *("sample_log_prob", "action_log_prob"),
    ("next", "reward"),
    ("next", "state_value"),
    ("collector", "traj_ids"),
    ("agents", "action_log_prob"),
]


@pytest.mark.parametrize("key", SHARED, ids=str)
def test_copies_share_what_does_not_transform(key):
    batch = make_batch(5)
    batch[key] = random(5, 1)
    for g in range(4):
        assert make_symmetry()(batch, g)[key].data_ptr() == batch[key].data_ptr()
    assert torch.equal(make_symmetry().orbit(batch)[key], batch[key].expand(4, 5, 1))


@pytest.mark.parametrize("parent", [(), ("agents",)], ids=str)
def test_mean_follows_the_action_and_scale_has_no_sign(parent):
    group = PointGroup.reflection("y")
    legs = signed_permutation(group, ["l", "r"], {"reflect-y": {"l": "-r", "r": "-l"}})
    symmetry = Symmetry(group, {(*parent, "action"): legs})
    batch = TensorDict(batch_size=[2])
    for leaf in ("action", "loc", "scale"):
        batch[(*parent, leaf)] = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    image = symmetry(batch, "reflect-y")
    assert image[(*parent, "action")].tolist() == [[-2, -1], [-4, -3]]
    assert image[(*parent, "loc")].tolist() == [[-2, -1], [-4, -3]]
    assert image[(*parent, "scale")].tolist() == [[2, 1], [4, 3]]


def test_scale_of_entries_that_mix_must_be_declared():
    group = PointGroup.rotation(3)
    batch = TensorDict(action=random(5, 2), scale=random(5, 2).exp(), batch_size=[5])
    with pytest.raises(KeyError, match=r"the batch has 'scale' .* mixes components"):
        Symmetry(group, {"action": planar(group)})(batch, 1)
    declared = Symmetry(group, {"action": planar(group), "scale": invariant(group, 2)})
    assert torch.equal(declared(batch, 1)["scale"], batch["scale"])


UNKNOWN = ["torque", ("next", "torque"), ("agents", "torque")]


@pytest.mark.parametrize("act", [lambda s, td: s(td, 1), lambda s, td: s.orbit(td)], ids=["one", "orbit"])
@pytest.mark.parametrize("key", UNKNOWN, ids=str)
def test_unknown_entries_are_refused(key, act):
    batch = make_batch(5)
    batch[key] = random(5, 1)
    with pytest.raises(KeyError, match=r"torque.*does not know.*invariant\(group, d\).*strict=False"):
        act(make_symmetry(), batch)


@pytest.mark.parametrize("key", UNKNOWN, ids=str)
def test_unknown_entries_are_copied_when_not_strict(key):
    batch = make_batch(5)
    batch[key] = random(5, 1)
    image = make_symmetry(strict=False)(batch, 1)
    assert torch.equal(image[key], batch[key])
    assert torch.equal(image["observation"], make_symmetry()(make_batch(5), 1)["observation"])


@pytest.mark.parametrize("shape", [(5, 3), (5,), (5, 4, 3)], ids=str)
def test_wrong_sizes_are_refused(shape):
    batch = make_batch(5, observation=torch.zeros(shape))
    with pytest.raises(ValueError, match=r"entry 'observation': expected event dimensions \(4,\), got"):
        make_symmetry().orbit(batch)


def test_getitem_lists_what_there_is():
    with pytest.raises(
        KeyError, match=r"no representation for 'torque'; this symmetry has .*'observation'"
    ):
        make_symmetry()["torque"]
    assert "torque" not in make_symmetry()


def test_require_names_the_reader_and_what_is_missing():
    make_symmetry().require(["observation", ("next", "observation")], "MyLoss")
    with pytest.raises(
        KeyError, match=r"MyLoss reads \['torque'\], which this symmetry does not transform"
    ):
        make_symmetry().require(["observation", "torque"], "MyLoss")


# --- what stays as it was


def test_specs_of_the_environment_are_not_modified():
    env = SpecEnv({"observation": ANY}, UNIT)
    before = env.observation_spec.clone()
    make_symmetry().check_specs(env)
    assert env.observation_spec == before


def test_input_is_not_modified():
    batch = make_batch(5, 3)
    before = batch.clone()
    make_symmetry()(batch, 1)
    make_symmetry()(batch, torch.ones(5, 3, dtype=torch.long))
    make_symmetry().orbit(batch.lock_())
    assert_same(batch, before)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("group", ["K4", "C3"])
def test_dtype_names_and_device_are_kept(group, dtype):
    batch = make_batch(5, 3, dtype=dtype).to("cpu")
    batch.names = [None, "time"]
    image = make_symmetry(group)(batch, 1)
    assert image["observation"].dtype == image["action"].dtype == dtype
    assert image.names == [None, "time"] and image.device == batch.device


def test_nothing_is_saved_or_trained():
    assert not make_symmetry("D3").state_dict()
    assert not list(make_symmetry("D3").parameters())


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
@pytest.mark.parametrize("group", ["K4", "D3"])
def test_copies_act_alike(group, duplicate):
    symmetry, batch = make_symmetry(group), make_batch(5)
    assert_same(duplicate(symmetry).orbit(batch), symmetry.orbit(batch))


# --- construction


def test_constructor_refuses_what_is_no_representation_of_its_group():
    group = PointGroup.rotation(3)
    with pytest.raises(ValueError, match="expected at least one key with its representation, got none"):
        Symmetry(group, {})
    with pytest.raises(TypeError, match=r"expected a Representation for 'action', got Tensor; build one"):
        Symmetry(group, {"action": group.matrices})
    with pytest.raises(
        ValueError, match=r"'action' belongs to PointGroup\(identity, reflect-x\), expected"
    ):
        Symmetry(group, {"action": pseudoscalar(PointGroup.reflection("x"))})


@pytest.mark.parametrize(
    "elements, indices",
    [
        ("all", [0, 1, 2, 3]),
        ("random", [0, 1, 2, 3]),
        (["rot-180", "reflect-x"], [0, 3, 1]),
        (["identity"], [0]),
    ],
)
def test_elements_start_with_the_identity(elements, indices):
    assert make_symmetry().elements(elements) == indices


@pytest.mark.parametrize(
    "elements, error, message",
    [
        ("reflect-x", ValueError, "expected 'all', 'random' or a sequence of names from .*got 'reflect-x'"),
        ([], ValueError, "expected distinct element names, at least one"),
        (["reflect-x", "reflect-x"], ValueError, "expected distinct element names"),
        (["rot-90"], KeyError, "no element 'rot-90'"),
    ],
)
def test_bad_elements_are_refused(elements, error, message):
    with pytest.raises(error, match=message):
        make_symmetry().elements(elements)


# --- specs of an environment


class SpecEnv(EnvBase):
    """An environment that only has specs."""

    def __init__(self, observation, action, batch_size=()):
        super().__init__(batch_size=batch_size)
        self.observation_spec = Composite(observation, shape=batch_size)
        self.action_spec = Composite(action, shape=batch_size) if isinstance(action, dict) else action
        self.reward_spec = Unbounded((*batch_size, 1))

    def _reset(self, tensordict=None, **kwargs):
        raise NotImplementedError

    _step = _reset

    def _set_seed(self, seed):
        raise NotImplementedError


def box(low: list[float], high: list[float]) -> Bounded:
    return Bounded(low=torch.tensor(low), high=torch.tensor(high), shape=(len(low),))


ANY = Unbounded(4)
UNIT = box([-1, -1], [1, 1])
INF = math.inf


@pytest.mark.parametrize(
    "group, observation, action",
    [
        ("K4", ANY, UNIT),
        ("K4", box([-1, -2, 0, -4], [1, 2, 3, 4]), box([-1, -2], [1, 2])),
        ("K4", box([-INF, -INF, 0, -INF], [INF] * 4), box([-INF, -1], [INF, 1])),
        ("reflect-y", ANY, box([0, -1], [3, 1])),
        ("C4", ANY, UNIT),
        ("C3", ANY, Unbounded(2)),
        ("C3", ANY, box([-INF, -INF], [INF, INF])),
        ("trivial", ANY, box([2, 3], [5, 7])),
    ],
)
def test_symmetric_boxes_pass(group, observation, action):
    make_symmetry(group).check_specs(SpecEnv({"observation": observation}, action))


@pytest.mark.parametrize(
    "group, action, message",
    [
        ("K4", box([-1, -1], [1, 2]), r"'action': .* entry 1, \[-1, 2\].*'reflect-y'.*\[-2, 1\]"),
        ("K4", box([0, -1], [1, 1]), r"entry 0, \[0, 1\], is not mapped onto itself by 'reflect-x'"),
        ("K4", box([0, -1], [INF, 1]), r"entry 0, \[0, inf\], .* whose image there is \[-inf"),
        ("C4", box([-1, -2], [1, 2]), r"entry 0, \[-1, 1\], .* 'rot-90', whose image there is \[-2, 2\]"),
        ("C3", UNIT, "'action': the box of entry 0, .* 'rot-120'.*make the box symmetric"),
        ("K4", box([-1, math.nan], [1, 1]), "'action': expected a box of numbers, got NaN in its bounds"),
        ("K4", Unbounded(3), r"entry 'action': expected event dimensions \(2,\), got \(3,\)"),
        ("K4", Unbounded(()), r"entry 'action': expected event dimensions \(2,\), got \(\)"),
        ("K4", Categorical(3), r"entry 'action': expected event dimensions \(2,\), got \(\)"),
    ],
)
def test_asymmetric_actions_are_refused(group, action, message):
    with pytest.raises(ValueError, match=message):
        make_symmetry(group).check_specs(SpecEnv({"observation": ANY}, action))


@pytest.mark.parametrize(
    "observation, message",
    [
        (box([-1] * 4, [1, 2, 1, 1]), "'observation': the box of entry 1"),
        (Unbounded(3), r"entry 'observation': expected event dimensions \(4,\), got \(3,\)"),
    ],
)
def test_asymmetric_observations_are_refused(observation, message):
    with pytest.raises(ValueError, match=message):
        make_symmetry().check_specs(SpecEnv({"observation": observation}, UNIT))


def test_boxes_of_every_environment_of_a_batch_are_checked():
    high = torch.ones(3, 2)
    observation = {"observation": Unbounded((3, 4))}
    make_symmetry().check_specs(SpecEnv(observation, Bounded(low=-high, high=high, shape=(3, 2)), [3]))
    skewed = high.clone()
    skewed[2, 0] = 5
    with pytest.raises(ValueError, match=r"entry 0, \[-1, 5\]"):
        make_symmetry().check_specs(
            SpecEnv(observation, Bounded(low=-high, high=skewed, shape=(3, 2)), [3])
        )


def test_nested_specs_are_found():
    group = PointGroup.reflection("y")
    symmetry = Symmetry(
        group, {("agents", "observation"): polar(group), ("agents", "action"): planar(group)}
    )
    observation = {"agents": Composite(observation=Unbounded(3))}
    symmetry.check_specs(SpecEnv(observation, {"agents": Composite(action=UNIT)}))
    with pytest.raises(ValueError, match=r"\('agents', 'action'\): the box of entry 1"):
        symmetry.check_specs(SpecEnv(observation, {"agents": Composite(action=box([-1, 0], [1, 1]))}))


def test_undeclared_specs_are_refused_unless_not_strict():
    env = SpecEnv({"observation": ANY, "heights": Unbounded(7)}, UNIT)
    with pytest.raises(KeyError, match=r"'heights'\], which this symmetry does not know"):
        make_symmetry().check_specs(env)
    make_symmetry(strict=False).check_specs(env)
