"""SymmetryAugment, a function of a batch: layouts, log-probabilities, refusals, collectors."""

import copy
import pickle

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import Compose, DoubleToFloat, EnvBase, TransformedEnv
from torchrl.modules import IndependentNormal, TanhNormal

from tests.buffers import MAPPED, SHARED, drawn_elements, same
from tests.networks import ACTION_DIM, GROUPS, OBSERVATION_DIM, make_actor, make_batch, make_symmetry
from torchrl_sym import SymmetryAugment, SymmetryOrbit

K4 = GROUPS["K4"]


every_symmetric_group = pytest.mark.parametrize("group", ["C1", "C2", "K4", "C3"])
every_shape = pytest.mark.parametrize("shape", [(8,), (8, 4)], ids=str)

# --- layouts


@every_symmetric_group
@every_shape
def test_cat_puts_the_copies_behind_the_originals(group, shape):
    batch, symmetry = make_batch(*shape), make_symmetry(group)
    out = SymmetryAugment(symmetry)(batch)
    assert out.batch_size == (8 * len(symmetry.group), *shape[1:])
    for g, block in enumerate(out.split(8)):
        assert same(block, symmetry(batch, g))


@every_symmetric_group
@every_shape
def test_stack_puts_the_copies_beside_the_originals(group, shape):
    batch, symmetry = make_batch(*shape), make_symmetry(group)
    out = SymmetryAugment(symmetry, layout="stack")(batch)
    assert out.batch_size == (*shape, len(symmetry.group))
    for g in range(len(symmetry.group)):
        assert same(out[..., g], symmetry(batch, g))


@pytest.mark.parametrize("layout", ["cat", "stack"])
def test_named_elements_come_after_the_identity(layout):
    batch, symmetry = make_batch(8), make_symmetry("K4")
    out = SymmetryAugment(symmetry, elements=["rot-180", "reflect-x"], layout=layout)(batch)
    blocks = out.split(8) if layout == "cat" else out.unbind(-1)
    assert len(blocks) == 3
    assert all(same(block, symmetry(batch, g)) for block, g in zip(blocks, (0, 3, 1), strict=True))


@pytest.mark.parametrize("layout", ["cat", "stack"])
def test_copies_share_log_probability_advantage_and_return(layout):
    batch = make_batch(8)
    out = SymmetryAugment(make_symmetry("K4"), layout=layout)(batch)
    blocks = out.split(8) if layout == "cat" else out.unbind(-1)
    assert all(same(block.select(*SHARED), batch.select(*SHARED)) for block in blocks)


@pytest.mark.parametrize(
    "settings, names",
    [
        ({"layout": "cat"}, [None, "time"]),
        ({"layout": "stack"}, [None, "time", None]),
        ({"elements": "random"}, [None, "time"]),
    ],
    ids=["cat", "stack", "random"],
)
def test_dimension_names_are_kept(settings, names):
    batch = make_batch(8, 4)
    batch.names = [None, "time"]
    assert SymmetryAugment(make_symmetry("K4"), **settings)(batch).names == names


def test_copies_are_trajectories_of_their_own():
    batch = make_batch(6)
    ids = torch.tensor([0, 0, 0, 1, 1, 7])
    batch["collector", "traj_ids"] = ids
    blocks = SymmetryAugment(make_symmetry("K4"))(batch)["collector", "traj_ids"].split(6)
    assert len({int(i) for block in blocks for i in block}) == 4 * 3
    assert all(torch.equal(block.diff() != 0, ids.diff() != 0) for block in blocks)


@pytest.mark.parametrize("make", [lambda td: td.lock_(), lambda td: LazyStackedTensorDict(*td.unbind(0))])
def test_locked_and_lazy_batches(make):
    batch, augment = make_batch(8), SymmetryAugment(make_symmetry("K4"))
    assert same(augment(make(batch.clone())), augment(batch))


# --- where it is called from


def test_it_may_be_called_by_a_buffer():
    class Averaging(ReplayBuffer):
        """Computes something on the copies of what it samples; no business of its transform."""

        def mean(self) -> torch.Tensor:
            return SymmetryAugment(make_symmetry("K4"))(self.sample())["observation"].mean(0)

    buffer = Averaging(storage=LazyTensorStorage(8), batch_size=8)
    buffer.extend(make_batch(8))
    assert buffer.mean()[:2].abs().max() < 1e-12  # K4 turns the first two around


# --- select


def test_select_copies_only_what_is_asked_for():
    batch = make_batch(8)
    batch["next", "observation"] = batch["observation"].clone()
    out = SymmetryAugment(make_symmetry("K4"), select=[*MAPPED, "advantage"])(batch)
    assert set(out.keys(True, True)) == {*MAPPED, "advantage"}
    assert same(out, SymmetryAugment(make_symmetry("K4"))(batch).select(*MAPPED, "advantage"))


def test_select_drops_entries_that_the_symmetry_does_not_know():
    batch = make_batch(8).set("torque", torch.zeros(8, 2))
    assert "torque" not in SymmetryAugment(make_symmetry(), select=MAPPED)(batch)
    with pytest.raises(KeyError, match="torque"):
        SymmetryAugment(make_symmetry(), select=["observation", "torque"])(batch)


def test_select_may_leave_out_a_declared_entry():
    out = SymmetryAugment(make_symmetry(), select=["observation"])(make_batch(8))
    assert list(out.keys()) == ["observation"]


# --- the naive rule: log-probabilities of the actor at the copies


def log_prob(actor, batch: TensorDictBase) -> torch.Tensor:
    with torch.no_grad():
        return actor.get_dist(batch.select("observation")).log_prob(batch["action"])


@pytest.mark.parametrize("distribution", [IndependentNormal, TanhNormal])
@pytest.mark.parametrize("layout", ["cat", "stack"])
@pytest.mark.parametrize("group", ["C2", "K4", "C3"])
def test_log_prob_from_asks_the_actor_about_the_copies(group, layout, distribution):
    actor, batch = make_actor(distribution), make_batch(8, bound=1.0)
    out = SymmetryAugment(make_symmetry(group), layout=layout, log_prob_from=actor)(batch)
    blocks = out.split(8) if layout == "cat" else out.unbind(-1)
    assert torch.equal(blocks[0]["action_log_prob"], batch["action_log_prob"])
    for block in blocks[1:]:
        torch.testing.assert_close(block["action_log_prob"], log_prob(actor, block))
        assert not torch.isclose(block["action_log_prob"], batch["action_log_prob"]).any()


def test_log_prob_from_with_random_elements():
    actor, batch = make_actor(), make_batch(64)
    out = SymmetryAugment(make_symmetry("K4"), elements="random", log_prob_from=actor)(batch)
    torch.testing.assert_close(out["action_log_prob"], log_prob(actor, out))


def test_log_prob_from_leaves_the_actor_to_its_owner():
    augment = SymmetryAugment(make_symmetry("K4"), log_prob_from=make_actor())
    assert not list(augment.parameters()) and not augment.state_dict()


# --- what stays as it was


@every_shape
@pytest.mark.parametrize("actor", [None, make_actor()], ids=["shared", "naive"])
@pytest.mark.parametrize("settings", [{}, {"layout": "stack"}, {"elements": "random"}], ids=str)
@pytest.mark.parametrize("group", ["C1", "C2", "K4"])
def test_input_is_not_modified(group, settings, actor, shape):
    batch = make_batch(*shape)
    batch["collector", "traj_ids"] = torch.zeros(shape, dtype=torch.long)
    before = batch.clone()
    SymmetryAugment(make_symmetry(group), log_prob_from=actor, **settings)(batch)
    assert same(batch, before) and set(batch.keys(True)) == set(before.keys(True))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))])
def test_copies_of_the_transform_act_alike(duplicate):
    augment, batch = SymmetryAugment(make_symmetry("C3"), elements=["rot-240"]), make_batch(8)
    assert same(duplicate(augment)(batch), augment(batch))


# --- refusals


@pytest.mark.parametrize(
    "settings, error, message",
    [
        ({"layout": "concat"}, ValueError, "layout: expected one of .*, got 'concat'"),
        ({"when": "add"}, ValueError, "when: expected one of .*, got 'add'"),
        ({"elements": "reflect-y"}, ValueError, "expected 'all', 'random' or a sequence of names"),
        ({"elements": ["reflect-z"]}, KeyError, "no element 'reflect-z'"),
    ],
    ids=["layout", "when", "element", "elements"],
)
def test_bad_settings_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        SymmetryAugment(make_symmetry("K4"), **settings)


def test_missing_entries_are_refused():
    batch = make_batch(8).rename_key_("action", "_action")
    with pytest.raises(KeyError, match=r"the batch lacks \['action'\].*'observation'.*pass select="):
        SymmetryAugment(make_symmetry())(batch)


def test_unknown_entries_are_refused():
    with pytest.raises(KeyError, match=r"the batch has \['torque'\], which this symmetry does not know"):
        SymmetryAugment(make_symmetry())(make_batch(8).set("torque", torch.zeros(8, 2)))


def test_a_single_record_has_no_batch_to_grow():
    augment, record = SymmetryAugment(make_symmetry()), make_batch(8)[0]
    assert augment(record) is record
    with pytest.raises(
        RuntimeError, match=r"at least one batch dimension, got batch size \[\]; use td.unsq"
    ):
        augment.augment(record)


def test_extend_time_transforms_do_nothing_when_sampled():
    batch = make_batch(8)
    assert SymmetryAugment(make_symmetry(), when="extend")(batch) is batch
    assert SymmetryAugment(make_symmetry(), when="sample").inv(batch).batch_size == batch.batch_size


def test_a_single_record_has_no_place_for_copies_to_be_stored():
    with pytest.raises(RuntimeError, match=r"no place .* use buffer.extend\(row.unsqueeze\(0\)\)"):
        SymmetryAugment(make_symmetry(), when="extend").inv(make_batch(8)[0])


def test_the_naive_rule_is_refused_where_it_would_meet_a_later_policy():
    augment = SymmetryAugment(make_symmetry(), log_prob_from=make_actor())
    with pytest.raises(RuntimeError, match=r"has changed by the time .* sampled; use when='extend'"):
        ReplayBuffer(storage=LazyTensorStorage(8), transform=augment)


# --- torch.compile


@pytest.mark.parametrize("settings", [{}, {"layout": "stack"}], ids=str)
def test_compiles_to_one_graph(settings):
    augment, batch = SymmetryAugment(make_symmetry("D3"), **settings), make_batch(8)
    compiled = torch.compile(augment.forward, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch).to_dict(), augment(batch).to_dict())


def test_random_elements_compile_to_one_graph():
    symmetry, batch = make_symmetry("K4"), make_batch(64)
    augment = SymmetryAugment(symmetry, elements="random")
    compiled = torch.compile(augment.forward, fullgraph=True, backend="aot_eager")
    assert drawn_elements(compiled(batch), batch, symmetry).unique().tolist() == [0, 1, 2, 3]


# --- environments and collectors


class Drift(EnvBase):
    """Four numbers that drift with the action; every step may be the last."""

    def __init__(self, batch_size: tuple[int, ...] = ()):
        super().__init__(batch_size=batch_size)
        self.observation_spec = Composite(
            observation=Unbounded((*batch_size, OBSERVATION_DIM)), shape=batch_size
        )
        self.action_spec = Bounded(-2.0, 2.0, shape=(*batch_size, ACTION_DIM))
        self.reward_spec = Unbounded((*batch_size, 1))

    def _set_seed(self, seed):
        torch.manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict(
            observation=torch.randn(*self.batch_size, OBSERVATION_DIM), batch_size=self.batch_size
        )

    def _step(self, tensordict):
        push = torch.nn.functional.pad(tensordict["action"], (0, 1))
        done = torch.rand(*self.batch_size, 1) < 0.2
        out = {"observation": tensordict["observation"] + push, "reward": push[..., :1], "done": done}
        return TensorDict(out, batch_size=self.batch_size)


APPEND = {
    "at construction": lambda augment: TransformedEnv(Drift(), augment),
    "later": lambda augment: TransformedEnv(Drift(), DoubleToFloat()).append_transform(augment),
    "by the environment": lambda augment: Drift().append_transform(augment),
    "in a Compose": lambda augment: TransformedEnv(Drift(), Compose(DoubleToFloat(), augment)),
    "to a Compose": lambda augment: TransformedEnv(Drift(), Compose(DoubleToFloat())).append_transform(
        augment
    ),
}


@pytest.mark.parametrize("append", APPEND.values(), ids=APPEND)
@pytest.mark.parametrize(
    "make",
    [
        lambda symmetry: SymmetryAugment(symmetry, when="sample"),
        lambda symmetry: SymmetryAugment(symmetry, when="extend"),
        lambda symmetry: SymmetryOrbit(symmetry).transform(),
    ],
    ids=["sample", "extend", "orbit"],
)
def test_environments_are_refused(append, make):
    with pytest.raises(
        RuntimeError, match=r"cannot be appended to an environment; use it in a replay buffer"
    ):
        append(make(make_symmetry()))


def collect(collector) -> TensorDictBase:
    try:
        return next(iter(collector))
    finally:
        collector.shutdown()


def policy():
    return make_actor(TanhNormal, dtype=torch.float32)


@pytest.mark.parametrize("layout, shape", [("cat", (12, 6)), ("stack", (3, 6, 4))])
def test_postproc_of_a_collector(layout, shape):
    augment = SymmetryAugment(make_symmetry("K4"), layout=layout)
    collector = Collector(Drift((3,)), policy(), frames_per_batch=18, total_frames=18, postproc=augment)
    batch = collect(collector)
    blocks = batch.split(3) if layout == "cat" else batch.unbind(-1)
    assert batch.batch_size == shape and batch.names[1] == "time"
    for g, block in enumerate(blocks):
        expected = make_symmetry("K4")(blocks[0].exclude("collector"), g)
        assert same(block.exclude("collector"), expected)


def test_postproc_does_not_count_as_frames():
    augment = SymmetryAugment(make_symmetry("K4"))
    collector = Collector(Drift((3,)), policy(), frames_per_batch=18, total_frames=54, postproc=augment)
    assert [batch.numel() for batch in collector] == [72, 72, 72]
    collector.shutdown()


@pytest.mark.slow
def test_postproc_of_processes_that_collect_in_step():
    augment = SymmetryAugment(make_symmetry("C2"))
    workers = dict(cat_results="stack", frames_per_batch=24, total_frames=24)
    batch = collect(MultiSyncCollector([Drift, Drift], policy(), postproc=augment, **workers))
    original, mirrored = batch.split(batch.shape[0] // 2)
    assert batch.numel() == 48
    assert same(mirrored.exclude("collector"), make_symmetry("C2")(original.exclude("collector"), 1))
