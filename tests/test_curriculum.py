"""Curricula: levels, running averages, and how the tasks judge the episodes that ended."""

import math

import pytest
import torch
from tensordict import TensorDict

from tasks.anymal_climb import LAST_LEVEL as LAST_BOX
from tasks.anymal_climb import AnymalClimb
from tasks.anymal_push import LAST_LEVEL as LAST_TARGET
from tasks.anymal_push import AnymalPush
from tasks.curriculum import EPISODE_WEIGHT, Averages, Curriculum, next_level
from tasks.environment import BatchedEnv
from tasks.trifinger_repose import TrifingerRepose
from tests.task_helpers import actions, assert_same, make, play

BOX = 1.0  # half the edge of the box to climb, m


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def flags(text):
    return torch.tensor([character == "x" for character in text])


def test_a_level_rises_after_success_falls_after_failure_and_never_below_zero():
    level = torch.tensor([0.0, 0.0, 3.0, 3.0, 3.0, 7.0])
    after = next_level(level, flags("x.x..."), flags(".x.x.x"), 7, None)
    assert after.tolist() == [1.0, 0.0, 4.0, 2.0, 3.0, 6.0]


def test_whoever_passes_the_last_level_starts_anywhere():
    n = 4000
    after = next_level(torch.full((n,), 7.0), torch.ones(n).bool(), torch.zeros(n).bool(), 7, generator())
    share = torch.bincount(after.long(), minlength=8) / n
    assert len(share) == 8 and (share - 1 / 8).abs().max() < 0.03
    assert torch.equal(after, after.round())


def test_averages_start_with_the_first_episodes_and_remember_about_500():
    averages = Averages("success", "level")
    averages.update(success=torch.zeros(0), level=torch.zeros(0))
    assert all(math.isnan(value) for value in averages.values.values())
    averages.update(
        success=torch.tensor([True, False, True, True]), level=torch.tensor([2.0, 4.0, 2.0, 4.0])
    )
    assert averages.values == {"success": 0.75, "level": 3.0}
    averages.update(level=torch.zeros(1))
    assert averages.values == {"success": 0.75, "level": pytest.approx(3.0 * (1 - EPISODE_WEIGHT))}
    together, apart = Averages("x"), Averages("x")
    for one in (together, apart):
        one.update(x=torch.ones(1))
    together.update(x=torch.zeros(500))
    for _ in range(500):
        apart.update(x=torch.zeros(1))
    assert together.values["x"] == pytest.approx(apart.values["x"]) == pytest.approx(1 / math.e, abs=0.01)


def test_averages_of_another_version_of_a_task_are_kept_where_this_one_has_them():
    plain, oriented = TrifingerRepose(), TrifingerRepose(yaw=math.pi)
    plain.curriculum.averages.update(success=torch.ones(1), error=torch.ones(1), level=torch.ones(1))
    oriented.load_state_dict(plain.state_dict())
    assert oriented.metrics()["success"] == 1.0 and math.isnan(oriented.metrics()["angle"])
    oriented.curriculum.averages.update(angle=torch.ones(1))
    plain.load_state_dict(oriented.state_dict())
    assert plain.metrics() == {"success": 1.0, "error": 1.0, "level": 1.0}


def test_a_curriculum_judges_whole_episodes_and_success_before_failure():
    curriculum = Curriculum(7, "success", "level", "distance")
    assert curriculum.start(2).tolist() == [0.0, 0.0] and curriculum.hardest(1).tolist() == [7.0]
    level = curriculum.judge(
        torch.full((5,), 3.0),
        whole=flags("xxxx."),
        success=flags("x.x.x"),
        failed=flags("..xxx"),
        generator=None,
        distance=torch.tensor([1.0, 2.0, 3.0, 4.0, 9.0]),
    )
    assert level.tolist() == [4.0, 3.0, 4.0, 2.0, 3.0]
    assert curriculum.averages.values == {"success": 0.5, "level": 3.0, "distance": 2.5}


def test_a_curriculum_that_does_not_rise_stays_at_the_last_level_and_draws_nothing():
    curriculum, random = Curriculum(7, "success", "level", rising=False), generator()
    before = random.get_state()
    level = torch.tensor([7.0, 7.0])
    after = curriculum.judge(
        level, whole=flags("xx"), success=flags("x."), failed=flags(".x"), generator=random
    )
    assert curriculum.start(2).tolist() == after.tolist() == [7.0, 7.0]
    assert curriculum.averages.values == {"success": 0.5, "level": 7.0}
    assert torch.equal(random.get_state(), before)


@pytest.mark.parametrize(
    ("task", "saved"),
    [
        (AnymalPush, {"averages": {"success": 0.5, "level": 2.0}}),
        (AnymalClimb, {"phase": "B", "averages": {"success": 0.5, "level": 2.0, "distance": 0.3}}),
        (TrifingerRepose, {"success": 0.5, "error": 0.02, "level": 2.0}),
    ],
)
def test_states_are_stored_in_the_form_of_older_checkpoints(task, saved):
    restored = task()
    restored.load_state_dict(saved)
    assert restored.state_dict() == saved and restored.metrics()["success"] == 0.5


def finished_pushes(task):
    """Level 3: unstarted, half-way, success, no progress, half of the distance, fallen at once, late."""
    state = task.sample_goal_state(7, generator())
    state.variables["level"][:] = 3.0
    state.variables["start_distance"][:] = 1.0
    ahead = state.mocap_pos[:, 0, :2] / state.mocap_pos[:, 0, :2].norm(dim=-1, keepdim=True)
    distance = torch.tensor([0.1, 0.1, 0.1, 0.9, 0.5, 1.0, 0.1], dtype=torch.float64)
    state.qpos[:, 19:21] = state.mocap_pos[:, 0, :2] - distance[:, None] * ahead
    state.time[:] = torch.tensor([0.0, 3.5, 7.0, 7.0, 7.0, 0.4, 6.9])
    state.qpos[5:, 2] = 0.1
    return state


def test_push_judges_whole_episodes_only():
    task = AnymalPush()
    start = task.restart(finished_pushes(task), generator())
    level = start.variables["level"][:, 0]
    assert level.tolist() == [3.0, 3.0, 4.0, 2.0, 3.0, 2.0, 3.0]
    # Five are whole: a success, a failure, one in between, two falls.
    assert task.metrics() == {"success": pytest.approx(1 / 5), "level": pytest.approx(3.0)}
    assert start.time.tolist() == [0.0] * 7


def reach(state):
    """Distance of cube and target, m."""
    return (state.mocap_pos[:, 0, :2] - state.qpos[:, 19:21]).norm(dim=-1)


@pytest.mark.parametrize("level", [0, 3, LAST_TARGET])
def test_a_higher_level_moves_the_target_away(level):
    task, n = AnymalPush(), 2000
    finished = task.sample_initial_state(n, generator())  # time 0: levels stay
    finished.variables["level"][:] = level
    start = task.restart(finished, generator(1))
    distance = reach(start)
    low, high = 0.3 + 0.15 * level * 0.5, 0.3 + 0.15 * level
    assert distance.min() >= low - 1e-9 and distance.max() <= high + 1e-9
    if level:
        assert distance.mean() == pytest.approx((low + high) / 2, abs=0.02)
    for name in ("distance", "start_distance"):
        torch.testing.assert_close(start.variables[name][:, 0], distance, rtol=0, atol=1e-12)


def test_without_a_curriculum_pushes_go_over_the_whole_range():
    task = AnymalPush(curriculum=False)
    distance = reach(task.sample_initial_state(2000, generator()))
    assert distance.min() < 0.32 and distance.max() > 1.33


def test_without_a_curriculum_levels_do_not_change():
    task = AnymalPush(curriculum=False)
    start = task.restart(finished_pushes(task), generator())
    assert (start.variables["level"] == LAST_TARGET).all()
    assert task.metrics()["success"] == pytest.approx(1 / 5)


def finished_climbs(task, n=6):
    """Level 3: unstarted, half-way, success, too far, neither, fallen at once."""
    state = task.sample_goal_state(n, generator())
    state.variables["level"][:] = 3.0
    target = state.mocap_pos[:, 1]
    state.qpos[:, 0:3] = target
    state.qpos[:, 0] -= torch.tensor([0.0, 0.0, 0.2, 0.9, 0.7, 0.0], dtype=torch.float64)
    state.time[:] = torch.tensor([0.0, 4.0, 8.0, 8.0, 8.0, 0.4])
    state.qpos[5, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # on its back
    return state


def test_climb_judges_whole_episodes_only():
    task = AnymalClimb()
    finished = finished_climbs(task)
    assert task.success(finished).tolist() == [True, True, True, False, False, False]
    start = task.restart(finished, generator())
    assert start.variables["level"][:, 0].tolist() == [3.0, 3.0, 4.0, 2.0, 3.0, 2.0]
    metrics = task.metrics()
    assert metrics["success"] == pytest.approx(1 / 4) and metrics["level"] == 3.0
    assert metrics["distance"] == pytest.approx((0.2 + 0.9 + 0.7 + 0.0) / 4)


def test_standing_beside_the_box_or_lying_on_it_is_no_success():
    task = AnymalClimb()
    state = finished_climbs(task, n=6)
    top = state.mocap_pos[:, 0, 2] + BOX
    state.qpos[:, 0:2], state.qpos[:, 3:7] = (
        state.mocap_pos[:, 1, :2],
        torch.tensor([1.0, 0, 0, 0]).double(),
    )
    state.qpos[:, 2] = top + torch.tensor([0.5, 0.31, 0.29, 0.5, 0.5, 0.5], dtype=torch.float64)
    state.qpos[3, 1] += 0.49
    state.qpos[4, 1] += 0.51
    assert task.success(state).tolist() == [True, True, False, True, False, True]


@pytest.mark.parametrize("level", [0, 4, LAST_BOX])
def test_a_higher_level_raises_the_box(level):
    task, n = AnymalClimb(height=0.45), 1000
    finished = task.sample_initial_state(n, generator())
    finished.variables["level"][:] = level
    start = task.restart(finished, generator(1))
    top, target = start.mocap_pos[:, 0, 2] + BOX, start.mocap_pos[:, 1, 2]
    height = 0.05 + 0.4 * level / 8
    assert top.max() <= height + 1e-9 and top.min() >= 0.8 * height - 1e-9
    assert top.max() - top.min() > 0.15 * height
    torch.testing.assert_close(target - top, torch.full_like(top, 0.5))


def test_the_phase_of_a_checkpoint_counts_in_a_curriculum_alone():
    saved = AnymalClimb(phase="B").state_dict()
    rising, fixed = AnymalClimb(), AnymalClimb(phase="C", curriculum=False)
    for task in (rising, fixed):
        task.load_state_dict(saved)
    assert (rising.phase, fixed.phase) == ("B", "C")


@pytest.mark.parametrize("phase", ["A", "C"])
def test_without_a_curriculum_every_box_has_full_height_and_the_phase_stays(phase):
    task = AnymalClimb(height=0.3, phase=phase, curriculum=False)
    task.curriculum.averages.values = {"success": 1.0, "level": 8.0, "distance": 0.1}
    for state in (
        task.sample_initial_state(50, generator()),
        task.restart(finished_climbs(task), generator()),
    ):
        top = state.mocap_pos[:, 0, 2] + BOX
        torch.testing.assert_close(top, torch.full_like(top, 0.3))
    assert task.phase == phase


def test_phases_follow_each_other_as_climbing_succeeds():
    task = AnymalClimb()

    def after(success, level):
        task.curriculum.averages.values |= {"success": success, "level": level}
        unstarted = task.sample_initial_state(4, generator())
        return task.restart(unstarted, generator()), task.phase

    assert after(0.9, 4.9)[1] == "A", "the boxes are still low"
    assert after(0.69, 6.0)[1] == "A"
    assert after(0.71, 5.1)[1] == "B"
    assert task.metrics()["success"] == 0.0, "the next phase is judged by its own episodes"
    start, phase = after(0.5, 8.0)
    assert phase == "B" and not start.qpos[:, 4:6].any()
    assert after(0.8, 8.0)[1] == "C"
    assert after(0.9, 8.0)[1] == "C"
    assert task.metrics()["phase"] == 2.0


def test_only_phase_c_starts_with_any_heading():
    for phase, headings in (("A", {0.0}), ("B", {0.0}), ("C", None)):
        task = AnymalClimb(phase=phase)
        start = task.sample_goal_state(200, generator())
        yaw = 2 * torch.atan2(start.qpos[:, 6], start.qpos[:, 3])
        if headings:
            assert set(yaw.tolist()) == headings
        else:
            assert yaw.min() < -2.8 and yaw.max() > 2.8 and abs(yaw.mean()) < 0.5
        # The heading asked for is the one at the start.
        error = task.observe(start)[:, 48:50]
        torch.testing.assert_close(error, torch.tensor([1.0, 0.0]).expand(200, 2), rtol=0, atol=1e-6)


def test_only_phase_a_rewards_walking_towards_the_target():
    for phase, paid in (("A", True), ("B", False), ("C", False)):
        task = AnymalClimb(phase=phase)
        terms = task.reward_terms(task.sample_initial_state(8, generator()), torch.zeros(8, 12))
        assert bool((terms["velocity"] > 0).all()) == paid


@pytest.mark.parametrize("task_class", [AnymalPush, AnymalClimb])
def test_what_a_task_learned_survives_its_state_dict(task_class):
    task, other = task_class(), task_class()
    task.curriculum.averages.values |= {"success": 0.25, "level": 2.5}
    if task_class is AnymalClimb:
        task._phase = 1
    other.load_state_dict(task.state_dict())
    assert other.metrics().keys() == task.metrics().keys()
    assert other.metrics()["success"] == 0.25
    assert getattr(other, "phase", "A") == getattr(task, "phase", "A")
    task.curriculum.averages.values["success"] = 0.75
    assert other.metrics()["success"] == 0.25, "must not share memory"


@pytest.mark.parametrize("name", ["anymal_push", "anymal_climb"])
def test_levels_phase_and_averages_continue_exactly(name):
    def env(seed):
        env = make(name, num_envs=4, seed=seed, episode_seconds=0.2)
        start = env.task.sample_initial_state(4, generator())
        start.variables["level"][:, 0] = torch.tensor([7.0, 5.0, 2.0, 0.0])
        if name == "anymal_climb":  # at the first reset phase B begins
            env.task.curriculum.averages.values |= {"success": 0.9, "level": 6.0}
        return env, env.reset_to(start)

    first, td = env(0)
    sequence = 0.3 * actions(first, 36)
    whole = play(first, td, sequence)
    assert first.state.variables["level"][:, 0].tolist() != [7.0, 5.0, 2.0, 0.0]
    saved, td = env(0)
    play(saved, td, sequence[:14])
    resumed, _ = env(9)
    resumed.restore_state(saved.save_state())
    assert resumed.task.metrics() == saved.task.metrics()
    assert_same(play(resumed, resumed.reset(), sequence[14:]), whole[14:])
    assert resumed.task.metrics() == first.task.metrics()
    for key, value in first.state.variables.items():
        assert torch.equal(resumed.state.variables[key], value), key
    assert getattr(resumed.task, "phase", "B") == "B"


@pytest.mark.parametrize("name", ["anymal_push", "anymal_climb"])
def test_rows_reset_early_or_diverged_keep_their_level_and_count_nowhere(name):
    env = make(name, num_envs=3)
    start = env.task.sample_initial_state(3, generator())
    start.variables["level"][:] = 5.0
    td = env.reset_to(start)
    action = torch.zeros(3, 12)
    action[1] = torch.nan
    out, _ = env.step_and_maybe_reset(td.set("action", action))
    assert out["next", "terminated"][:, 0].tolist() == [False, True, False]
    env.reset()
    assert env.state.variables["level"][:, 0].tolist() == [5.0] * 3
    assert env.metrics()["diverged"] == 1
    assert math.isnan(env.metrics()["success"]) and math.isnan(env.metrics()["level"])


def test_success_in_an_environment_moves_the_next_target_away():
    env = BatchedEnv(AnymalPush(episode_seconds=0.04), 2, num_threads=1, seed=0)
    start = env.task.sample_initial_state(2, generator())
    start.qpos[0, 19:21] = start.mocap_pos[0, 0, :2]
    start.variables["level"][:] = 4.0
    td = env.reset_to(start)
    play(env, td, torch.zeros(2, 2, 12))
    assert env.state.variables["level"][:, 0].tolist() == [5.0, 3.0]
    assert env.metrics()["success"] == 0.5
    env.step(TensorDict(action=torch.zeros(2, 12), batch_size=[2]))
    assert env.state.variables["start_distance"][0] >= 0.3 + 0.15 * 5 * 0.5
