"""What copies share, what follows the action, and what changes places: entries by their kind."""

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict
from torchrl.envs import (
    Compose,
    InitTracker,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

import tasks
from torchrl_sym import PointGroup, Symmetry, SymmetryAugment
from torchrl_sym.entries import Exchanged
from torchrl_sym.representations import (
    invariant,
    items,
    planar,
    pseudoscalar,
    signed_permutation,
)

GROUP = PointGroup.reflection("y")
SWAP = {"l": "-r", "r": "-l", "m": "m"}
JOINTS = signed_permutation(GROUP, ["l", "m", "r"], {"reflect-y": SWAP})
PLACES = signed_permutation(GROUP, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
SIGN = pseudoscalar(GROUP)
SYMMETRY = Symmetry(GROUP, {"observation": SIGN, "action": JOINTS})


def batch(**entries) -> TensorDict:
    torch.manual_seed(0)
    given = {
        name: value if isinstance(value, torch.Tensor) else torch.randn(5, *value)
        for name, value in entries.items()
    }
    return TensorDict(
        {"observation": torch.randn(5, 1), "action": torch.randn(5, 3), **given}, batch_size=[5]
    )


@pytest.mark.parametrize(
    "name", ["action_log_prob", "sample_log_prob", "advantage", "reward", "value_target", "done"]
)
@pytest.mark.parametrize("tail", [(), (1,)], ids=["flat", "column"])
def test_one_number_per_entry_of_the_action_changes_places_without_signs(name, tail):
    td = batch(**{name: (3, *tail)})
    expected = td[name].flip(1)
    for image in (SYMMETRY(td, 1), SYMMETRY(td, torch.ones(5, dtype=torch.long)), SYMMETRY.orbit(td)[1]):
        assert torch.equal(image[name], expected)
    assert torch.equal(SYMMETRY(td, 0)[name], td[name])


@pytest.mark.parametrize(
    "name", ["action_log_prob", "advantage", "reward", "state_value", "mask", "_private"]
)
def test_one_number_per_row_is_shared(name):
    for shape in ((), (1,)):
        td = batch(**{name: shape})
        assert torch.equal(SYMMETRY(td, 1)[name], td[name])


@pytest.mark.parametrize("name", ["action_log_prob", "advantage", "reward", "mask", "_hidden", "returns"])
def test_numbers_of_no_entry_of_the_action_are_refused(name):
    with pytest.raises(KeyError, match=rf"{name}.*does not know"):
        SYMMETRY(batch(**{name: (7,)}), 1)


def test_private_numbers_are_not_taken_for_those_of_the_action():
    with pytest.raises(KeyError, match=r"'_joint_velocity'.*does not know"):
        SYMMETRY(batch(_joint_velocity=(3,)), 1)


def test_one_number_per_entry_of_an_action_that_mixes_them_is_refused():
    group = PointGroup.rotation(3)
    td = batch(action=(2,), action_log_prob=(2,), observation=(1,))
    with pytest.raises(KeyError, match=r"mixes components.*IndependentNormal"):
        Symmetry(group, {"observation": invariant(group, 1), "action": planar(group)})(td, 1)


@pytest.mark.parametrize("name", ["env_index", "policy_version", "hash", "index", "chosen_action_value"])
def test_bookkeeping_is_shared(name):
    td = batch(**{name: torch.arange(5)})
    assert torch.equal(SymmetryAugment(SYMMETRY)(td)[name], torch.arange(5).repeat(2))


def test_values_of_actions_follow_them():
    td = batch(action_value=(3,), logits=(3,), probs=(3,))
    image = SYMMETRY(td, 1)
    for name in ("action_value", "logits", "probs"):
        assert torch.equal(image[name], td[name].flip(1))


def test_all_unknown_entries_are_named_at_once():
    td = batch(torque=(2,), heat=(1,))
    with pytest.raises(KeyError, match=r"'torque', 'heat'"):
        SYMMETRY(td, 1)
    from tests.test_symmetry import SpecEnv, Unbounded

    env = SpecEnv({"observation": Unbounded(1), "torque": Unbounded(2), "heat": Unbounded(1)}, Unbounded(3))
    with pytest.raises(KeyError, match=r"'torque', 'heat'"):
        SYMMETRY.check_specs(env)


def test_text_is_no_entry_that_copies_share():
    td = batch()
    td["sentence"] = "turn left"
    with pytest.raises(KeyError, match="sentence"):
        SYMMETRY(td, 1)


@pytest.mark.parametrize("name", ["observation", "torque", ("next", "observation")], ids=str)
def test_entries_that_only_some_rows_of_a_lazy_stack_have_are_refused(name):
    one = TensorDict(action=torch.randn(3))
    other = one.clone().set(name, torch.randn(1))
    stack = LazyStackedTensorDict(one, other)
    for act in (lambda td: SYMMETRY(td, 1), SYMMETRY.orbit):
        with pytest.raises(KeyError, match="only some rows"):
            act(stack)
    whole = LazyStackedTensorDict(other, other.clone())
    if name == "observation":
        assert torch.equal(SYMMETRY(whole, 1)["observation"], -whole["observation"])


# --- entries of several keys that change places


ARM = signed_permutation(GROUP, ["yaw", "pitch"], {"reflect-y": {"yaw": "-yaw", "pitch": "pitch"}})


@pytest.mark.parametrize("prefix", [(), ("next",), ("robot",)], ids=str)
@pytest.mark.parametrize("form", ["items", "sum"])
def test_left_and_right_change_places(prefix, form):
    both = items(PLACES, ARM) if form == "items" else items(PLACES, ARM).flatten()
    bare = prefix[prefix == ("next",) :]
    symmetry = Symmetry(GROUP, {Exchanged((*bare, "left"), (*bare, "right")): both})
    td = TensorDict(batch_size=[1])
    td[(*prefix, "left")], td[(*prefix, "right")] = torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, 4.0]])
    for image in (symmetry(td, 1), symmetry.orbit(td)[1], symmetry(td, torch.ones(1, dtype=torch.long))):
        assert image[(*prefix, "left")].tolist() == [[-3.0, 4.0]]
        assert image[(*prefix, "right")].tolist() == [[-1.0, 2.0]]
    assert symmetry.together([(*prefix, "left")]) == [
        symmetry.together([(*prefix, "left")])[0],
        (*prefix, "right") if prefix else "right",
    ]
    with pytest.raises(KeyError, match="change places"):
        symmetry(td.exclude((*prefix, "right")), 1)
    with pytest.raises(KeyError, match="change places"):
        symmetry[(*bare, "left")]
    with pytest.raises(ValueError, match="event dimensions"):
        symmetry(td.set((*prefix, "right"), torch.zeros(1, 3)), 1)


@pytest.mark.parametrize(
    "here, there",
    [("left", "right"), ("l_arm", "r_arm"), (("left", "q"), ("right", "q")), ("q_Left", "q_Right")],
)
def test_sides_that_are_declared_one_by_one_are_refused(here, there):
    with pytest.raises(ValueError, match=r"change places under 'reflect-y'.*Exchanged"):
        Symmetry(GROUP, {here: ARM, there: ARM})
    other = PointGroup.reflection("x")  # left stays left
    Symmetry(other, {here: invariant(other, 2), there: invariant(other, 2)})
    Symmetry(GROUP, {Exchanged(here, there): ARM + ARM})  # said to stay in place


def test_sides_in_front_and_behind():
    group = PointGroup.reflection("x")
    with pytest.raises(ValueError, match="change places under 'reflect-x'"):
        Symmetry(group, {"front_feet": invariant(group, 2), "hind_feet": invariant(group, 2)})


@pytest.mark.parametrize("keys", [("left",), ("left", "left"), ("left", ("left",))], ids=str)
def test_exchanged_needs_distinct_keys(keys):
    with pytest.raises(ValueError, match="two or more distinct keys"):
        Exchanged(*keys)


def test_boxes_of_entries_that_change_places_are_checked():
    from tests.test_symmetry import SpecEnv, Unbounded, box

    symmetry = Symmetry(GROUP, {Exchanged("left", "right"): items(PLACES, ARM), "action": SIGN})
    symmetry.check_specs(
        SpecEnv({"left": box([-1, 0], [2, 3]), "right": box([-2, 0], [1, 3])}, Unbounded(1))
    )
    with pytest.raises(ValueError, match="is not mapped onto itself"):
        symmetry.check_specs(
            SpecEnv({"left": box([-1, 0], [2, 3]), "right": box([-1, 0], [2, 3])}, Unbounded(1))
        )
    with pytest.raises(KeyError, match=r"lacks \['right'\]"):
        symmetry.check_specs(SpecEnv({"left": Unbounded(2)}, Unbounded(1)))


# --- agents


AGENTS = Symmetry(
    GROUP,
    {("agents", "observation"): items(PLACES, ARM), ("agents", "action"): items(PLACES, SIGN)},
)


def agents() -> TensorDict:
    torch.manual_seed(0)
    inner = TensorDict(
        observation=torch.randn(4, 2, 2),
        action=torch.randn(4, 2, 1),
        action_log_prob=torch.randn(4, 2),
        advantage=torch.randn(4, 2, 1),
        reward=torch.randn(4, 2, 1),
        batch_size=[4, 2],
    )
    return TensorDict(agents=inner, batch_size=[4])


def test_agents_change_places_with_all_that_is_theirs():
    td = agents()
    image = SymmetryAugment(AGENTS)(td)[4:]["agents"]
    assert torch.equal(
        image["observation"], td["agents", "observation"].flip(1) * torch.tensor([-1.0, 1.0])
    )
    assert torch.equal(image["action"], -td["agents", "action"].flip(1))
    for name in ("action_log_prob", "advantage", "reward"):
        assert torch.equal(image[name], td["agents", name].flip(1))


def test_agents_whose_places_are_not_declared_are_refused():
    symmetry = Symmetry(GROUP, {("agents", "observation"): ARM, ("agents", "action"): SIGN})
    with pytest.raises(ValueError, match=r"event dimensions \(2,\), got \(2, 2\).*items"):
        symmetry(agents(), 1)


# --- what TorchRL's transforms write needs no declaration, wherever they are


@pytest.mark.parametrize("kind", [None, SerialEnv, ParallelEnv])
def test_counters_need_no_declaration(kind):
    def make():
        base = tasks.make_env("cartpole", num_envs=1, num_threads=1)
        return TransformedEnv(base, Compose(StepCounter(10), RewardSum(), InitTracker()))

    env = make() if kind is None else kind(2, make)
    tasks.make_env("cartpole", num_envs=1, num_threads=1).symmetry.check_specs(env)
    env.close(raise_if_closed=False)


# --- what belongs to entries that change places


TWO = {"left": torch.tensor([[1.0, 2.0]]), "right": torch.tensor([[3.0, 4.0]])}


@pytest.mark.parametrize("form", ["items", "sum"])
@pytest.mark.parametrize("event", [(), (1,), (2,), (2, 1)], ids=str)
def test_log_probabilities_of_two_heads_change_places_as_their_actions_do(form, event):
    both = items(PLACES, ARM)
    symmetry = Symmetry(GROUP, {Exchanged("left", "right"): both if form == "items" else both.flatten()})
    scores = {f"{name}_log_prob": torch.randn(1, *event) for name in TWO}
    td = TensorDict(TWO | scores, batch_size=[1])
    ones = torch.ones(1, dtype=torch.long)
    for image in (symmetry(td, 1), symmetry.orbit(td)[1], symmetry(td, ones)):
        assert torch.equal(image["left_log_prob"], scores["right_log_prob"])
        assert torch.equal(image["right_log_prob"], scores["left_log_prob"])
    with pytest.raises(KeyError, match=r"lacks \['right_log_prob'\], which change places"):
        symmetry(td.exclude("right_log_prob"), 1)


@pytest.mark.parametrize("form", ["items", "sum"])
def test_what_is_in_groups_that_change_places_does_so_too(form):
    both = items(PLACES, ARM) if form == "items" else items(PLACES, ARM).flatten()
    actions = Exchanged(("left", "action"), ("right", "action"))
    symmetry = Symmetry(GROUP, {actions: both, Exchanged(("left", "q"), ("right", "q")): both})
    torch.manual_seed(0)
    shapes = {"q": (2,), "action": (2,), "loc": (2,), "scale": (2,), "action_log_prob": (), "done": (1,)}
    sides = {
        side: TensorDict({k: torch.randn(3, *v) for k, v in shapes.items()}, batch_size=[3]) for side in TWO
    }
    after = {side: TensorDict(q=torch.randn(3, 2), reward=torch.randn(3, 1)) for side in TWO}
    td = TensorDict(**sides, next=TensorDict(after), reward=torch.randn(3, 1), batch_size=[3])
    image, signs = symmetry(td, 1), torch.tensor([-1.0, 1.0])
    for here, there in (("left", "right"), ("right", "left")):
        for name in ("q", "action", "loc"):
            assert torch.equal(image[here, name], td[there, name] * signs)
        for name in ("scale", "action_log_prob", "done"):
            assert torch.equal(image[here, name], td[there, name])
        assert torch.equal(image["next", here, "reward"], td["next", there, "reward"])
    assert torch.equal(image["reward"], td["reward"])
    assert symmetry.together([("next", "left", "reward")]) == [
        ("next", "left", "reward"),
        ("next", "right", "reward"),
    ]
    assert symmetry.together(["left"]) == ["left", "right"]


def test_groups_that_stay_in_place_keep_what_is_in_them():
    stay = Exchanged(("left", "action"), ("right", "action"))
    symmetry = Symmetry(GROUP, {stay: items(invariant(GROUP, 2), ARM)})
    td = TensorDict({(side, "action"): value for side, value in TWO.items()}, batch_size=[1])
    td["left", "reward"], td["right", "reward"] = torch.tensor([1.0]), torch.tensor([2.0])
    assert symmetry(td, 1)["left", "reward"] == 1


def test_groups_of_different_sizes_have_no_place_for_what_is_in_them():
    symmetry = Symmetry(GROUP, {Exchanged(("left", "action"), ("right", "action")): ARM + SIGN})
    td = TensorDict({("left", "action"): torch.ones(1, 2), ("right", "action"): torch.ones(1, 1)}, [1])
    td["left", "reward"], td["right", "reward"] = torch.tensor([1.0]), torch.tensor([2.0])
    with pytest.raises(KeyError, match="does not know"):
        symmetry(td, 1)


def test_how_components_change_places_is_known_before_a_graph_is_traced():
    symmetry = Symmetry(GROUP, {"observation": SIGN, "action": JOINTS})
    td = batch(action_log_prob=(3,))
    traced = torch.compile(symmetry.orbit, fullgraph=True, backend="eager")(td)
    assert torch.equal(traced[1]["action_log_prob"], td["action_log_prob"].flip(1))


def test_lazy_stacks_of_agents_are_augmented():
    td = agents()
    image = SymmetryAugment(AGENTS)(LazyStackedTensorDict(*td.unbind(0)))
    assert torch.equal(image["agents", "action"], SymmetryAugment(AGENTS)(td)["agents", "action"])
