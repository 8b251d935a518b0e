"""The batched physics: agreement with plain MuJoCo, fresh starts, divergence, saving."""

import mujoco
import numpy as np
import pytest
import torch

from tasks.simulation import Simulation

# A pendulum on a cart with a stateful actuator and a mocap body: every part of a state row is used.
MODEL = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="target" mocap="true" pos="1 2 3"/>
    <body>
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom size=".1" mass="1" contype="0" conaffinity="0"/>
      <body>
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size=".03" mass=".1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general joint="slide" dyntype="filter" dynprm="0.05" gainprm="5"/>
    <motor joint="hinge"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


def controls(steps, n, nu=2, seed=0):
    return torch.rand(steps, n, nu, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def run(simulation, ctrl, substeps=2):
    for u in ctrl:
        simulation.step(u, substeps)
    return simulation.save()["rows"]


def test_agrees_with_a_loop_over_plain_mujoco(model):
    simulation = Simulation(model, 3, num_threads=2)
    simulation.write(None, torch.full((3, 2), 0.3), torch.zeros(3, 2))
    ctrl = controls(40, 3)
    run(simulation, ctrl)
    for row in range(3):
        data = mujoco.MjData(model)
        data.qpos[:] = np.float32(0.3)
        for u in ctrl[:, row]:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, 2)
        np.testing.assert_array_equal(simulation.qpos[row], data.qpos)
        np.testing.assert_array_equal(simulation.qvel[row], data.qvel)
        assert simulation.time[row] == pytest.approx(0.8)


def test_results_do_not_depend_on_the_number_of_threads(model):
    ctrl = controls(30, 7)
    rows = [run(Simulation(model, 7, num_threads=t), ctrl) for t in (1, 2, 3)]
    assert torch.equal(rows[0], rows[1])
    assert torch.equal(rows[0], rows[2])
    assert rows[0].abs().sum() > 0


@pytest.mark.parametrize("ids", [torch.tensor([1, 3]), torch.tensor([False, True, False, True])])
def test_step_of_some_rows_leaves_the_others(model, ids):
    simulation = Simulation(model, 4, num_threads=2)
    before = run(simulation, controls(5, 4))
    simulation.step(controls(1, 4, seed=1)[0], 1, ids)
    assert simulation.time.tolist() == pytest.approx([0.1, 0.11, 0.1, 0.11])
    moved = (simulation.qpos != before[:, 1:3]).any(-1)
    assert moved.tolist() == [False, True, False, True]


@pytest.mark.parametrize("ids", [None, torch.tensor([2, 0]), torch.tensor([True, False, True])])
def test_write_forgets_the_previous_episode(model, ids):
    """A used row that is written continues exactly as a new simulation from the same state."""
    used, new = Simulation(model, 3, num_threads=1), Simulation(model, 3, num_threads=1)
    run(used, controls(20, 3))
    used.mocap_pos[:] = 7.0
    k = 3 if ids is None else 2
    qpos, qvel = torch.randn(k, 2), torch.randn(k, 2)
    for simulation in (used, new):
        simulation.write(ids, qpos, qvel)
    rows = slice(None) if ids is None else ids
    ctrl = controls(20, 3, seed=2)
    assert torch.equal(run(used, ctrl)[rows], run(new, ctrl)[rows])
    assert torch.equal(used.mocap_pos[rows][0, 0], torch.tensor([1.0, 2.0, 3.0]).double())


def test_write_sets_mocap_and_time(model):
    simulation = Simulation(model, 2, num_threads=1)
    quat = torch.tensor([[[0.0, 1.0, 0.0, 0.0]]])
    simulation.write(
        torch.tensor([1]), torch.zeros(1, 2), torch.zeros(1, 2), torch.ones(1, 1, 3), quat, torch.ones(1)
    )
    simulation.step(torch.zeros(2, 2))
    assert simulation.mocap_pos[:, 0, 0].tolist() == [1.0, 1.0]
    assert simulation.mocap_pos[:, 0, 2].tolist() == [3.0, 1.0]
    assert simulation.mocap_quat[1, 0].tolist() == quat[0, 0].tolist()
    assert simulation.time.tolist() == pytest.approx([0.01, 1.01])


@pytest.mark.parametrize(
    ("qpos", "message"),
    [
        (torch.full((2, 2), torch.nan), r"finite qpos of shape \(2, 2\).*4 entries that are not"),
        (torch.zeros(1, 2), r"qpos of shape \(2, 2\), got shape \(1, 2\)"),
        (torch.zeros(2, 3), r"got shape \(2, 3\)"),
        (np.zeros((2, 2)), "qpos: expected a tensor, got ndarray"),
    ],
)
def test_write_refuses_what_would_poison_the_state(model, qpos, message):
    simulation = Simulation(model, 2, num_threads=1)
    with pytest.raises((TypeError, ValueError), match=message):
        simulation.write(None, qpos, torch.zeros(2, 2))


def poison_control(simulation, ctrl):
    ctrl[1, 0] = torch.nan


def poison_control_inf(simulation, ctrl):
    ctrl[1] = torch.tensor([torch.inf, -torch.inf])


def poison_huge_control(simulation, ctrl):
    ctrl[1, 1] = 1e20


def poison_velocity(simulation, ctrl):
    simulation.qvel[1, 0] = 1e5


def poison_position(simulation, ctrl):
    simulation.qpos[1, 1] = torch.nan


def poison_nan_velocity(simulation, ctrl):
    simulation.qvel[1, 1] = torch.nan


@pytest.mark.parametrize(
    "poison",
    [
        poison_control,
        poison_control_inf,
        poison_huge_control,
        poison_velocity,
        poison_position,
        poison_nan_velocity,
    ],
)
def test_divergence_is_reported_once_and_stays_in_its_row(model, poison, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where it runs
    simulation, healthy = (Simulation(model, 3, num_threads=2) for _ in range(2))
    ctrl = controls(4, 3)
    for u in ctrl[:2]:
        assert not simulation.step(u)
        healthy.step(u)
    bad = ctrl[2].clone()
    poison(simulation, bad)
    assert simulation.step(bad)
    healthy.step(ctrl[2])
    assert simulation.diverged().tolist() == [False, True, False]
    assert simulation.qpos[1].tolist() == [0.0, 0.0]
    assert simulation.qvel[1].tolist() == [0.0, 0.0]
    assert simulation.save()["rows"].isfinite().all()
    assert not simulation.step(ctrl[3])
    healthy.step(ctrl[3])
    assert not simulation.diverged().any()
    others = torch.tensor([0, 2])
    assert torch.equal(simulation.save()["rows"][others], healthy.save()["rows"][others])


def test_max_velocity_is_the_limit(model):
    for limit, expected in ((10.0, True), (30.0, False)):
        simulation = Simulation(model, 1, num_threads=1, max_velocity=limit)
        simulation.qvel[0, 0] = -20.0
        assert simulation.step(torch.zeros(1, 2)) is expected


def test_save_and_load_continue_bit_for_bit(model):
    ctrl = controls(40, 4)
    simulation, other = (Simulation(model, 4, num_threads=t) for t in (2, 1))
    run(simulation, ctrl[:20])
    run(other, controls(7, 4, seed=9))
    saved = simulation.save()
    expected = run(simulation, ctrl[20:])
    other.load(saved)
    assert torch.equal(run(other, ctrl[20:]), expected)
    assert not torch.equal(saved["rows"], expected), "save() must copy"
    with pytest.raises(ValueError, match=r"saved rows of shape \(3, "):
        Simulation(model, 3, num_threads=1).load(saved)


def test_expanded_model_fields_act_per_row_and_are_saved(model):
    simulation = Simulation(model, 2, num_threads=1)
    mass = simulation.expand("body_mass")
    mass[1] *= 10.0
    simulation.refresh()
    run(simulation, controls(5, 1).expand(5, 2, 2))
    assert (simulation.qpos[0, 0] - simulation.qpos[1, 0]).abs() > 1e-4
    other = Simulation(model, 2, num_threads=1)
    other.load(simulation.save())
    ctrl = controls(5, 2, seed=1)
    assert torch.equal(run(other, ctrl), run(simulation, ctrl))
    assert torch.equal(other.expand("body_mass"), mass)


def test_fields_that_were_not_expanded_when_saved_return_to_the_models(model):
    simulation, other = (Simulation(model, 2, num_threads=1) for _ in range(2))
    run(simulation, controls(5, 2))
    other.expand("body_mass")[:, 2] = 5.0
    other.refresh()
    other.load(simulation.save())
    ctrl = controls(5, 2, seed=1)
    assert torch.equal(run(other, ctrl), run(simulation, ctrl))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda saved: saved.pop("rows"), r"expected saved with \['model.body_mass', 'rows'\], got "),
        (lambda saved: saved.update(rows=None), "expected saved rows to be a Tensor, got NoneType"),
        (lambda saved: saved.update(rows=saved["rows"].float()), "torch.float64, got .* and torch.float32"),
        (lambda saved: saved["rows"].fill_(torch.nan), "expected finite saved rows"),
        (lambda saved: saved.update({"model.body_mass": torch.ones(4)}), r"body_mass of shape \(2, 4\)"),
        (lambda saved: saved.update({"model.nothing": torch.ones(1)}), "nothing is not an expandable"),
        (lambda saved: saved.update(columns=torch.ones(1)), r"got \['columns', "),
    ],
)  # fmt: skip
def test_what_was_not_saved_is_not_loaded(model, change, message):
    simulation = Simulation(model, 2, num_threads=1)
    simulation.expand("body_mass")
    run(simulation, controls(5, 2))
    before, saved = simulation.save(), simulation.save()
    change(saved)
    with pytest.raises(ValueError, match=message):
        simulation.load(saved)
    assert torch.equal(simulation.save()["rows"], before["rows"])


@pytest.mark.parametrize("ids", [torch.tensor([0, 2]), torch.tensor([True, False, True])])
def test_a_bad_control_of_a_row_that_is_not_stepped_changes_nothing(model, ids):
    simulation = Simulation(model, 3, num_threads=1)
    before = run(simulation, controls(5, 3))[1]
    ctrl = torch.zeros(3, 2)
    ctrl[1] = torch.nan
    assert not simulation.step(ctrl, 1, ids)
    assert torch.equal(simulation.qpos[1], before[1:3])
    ctrl[0] = torch.inf
    assert simulation.step(ctrl, 1, ids)
    assert simulation.diverged().tolist() == [True, False, False]


def test_data_is_a_copy_with_derived_fields(model):
    simulation = Simulation(model, 2, num_threads=1)
    simulation.write(None, torch.tensor([[0.0, 0.0], [2.0, 0.0]]), torch.zeros(2, 2))
    data = simulation.data(1)
    assert data.xpos[2].tolist() == [2.0, 0.0, 0.0]
    data.qpos[0] = 5.0
    assert simulation.qpos[1, 0] == 2.0


@pytest.mark.parametrize("name", ["num_envs", "num_threads"])
@pytest.mark.parametrize(
    ("value", "error"),
    [
        (True, TypeError),
        (1.5, ValueError),
        (float("nan"), ValueError),
        ("2", TypeError),
        (None, TypeError),
        (-1, ValueError),
        (2**31, ValueError),
        (2**70, ValueError),
    ],
)
def test_numbers_of_simulations_and_threads(model, name, value, error):
    with pytest.raises(error, match=rf"{name}.*expected a whole number from \d to \d+, got "):
        Simulation(model, **{"num_envs": 2, name: value})


def test_whole_numbers_of_other_libraries_are_taken(model):
    simulation = Simulation(model, np.int64(2), torch.tensor(1.0))
    assert (type(simulation.num_envs), type(simulation.num_threads)) == (int, int)


def test_bad_arguments_say_what_is_expected(model):
    with pytest.raises(ValueError, match="num_envs: expected a whole number from 1"):
        Simulation(model, 0)
    with pytest.raises(ValueError, match="max_velocity > 0"):
        Simulation(model, 1, max_velocity=float("nan"))
    simulation = Simulation(model, 3, num_threads=1)
    with pytest.raises(ValueError, match=r"ctrl of shape \(3, 2\).*got \(3, 1\)"):
        simulation.step(torch.zeros(3, 1))
