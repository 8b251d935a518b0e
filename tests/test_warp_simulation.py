"""The engine on mujoco_warp, run on the CPU: agreement with MuJoCo's C library, and its own promises."""

import mujoco
import numpy as np
import pytest
import torch

pytest.importorskip(
    "mujoco_warp", reason="needs mujoco_warp: pip install 'torchrl_sym[gpu]'", exc_type=ImportError
)

from tasks.base import create
from tasks.engine import Engine
from tasks.simulation import Simulation
from tasks.warp_fields import wp
from tasks.warp_simulation import CONSTRAINTS, CONTACTS, WarpSimulation
from tests.test_host_waits import NoWaits, refused
from tests.warp_models import MODEL, controls, relative, run, state, warp


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def cartpole():
    return create("cartpole")


def test_cartpole_agrees_with_mujoco(cartpole):
    start = cartpole.sample_initial_state(4, torch.Generator().manual_seed(0))
    reference, simulation = Simulation(cartpole.model, 4, 1), warp(cartpole.model, 4)
    engines: list[Engine] = [reference, simulation]
    for engine in engines:
        engine.write(None, start.qpos, start.qvel, time=start.time)
    for number, u in enumerate(controls(50, 4, nu=1)):
        for engine in engines:
            engine.step(u, cartpole.substeps)
        if number == 0:
            assert relative(state(simulation), state(reference)) < 1e-4
            assert state(reference)[:, 2:].abs().min() > 1e-4, "all of them move"
    assert relative(state(simulation), state(reference)) < 1e-3
    torch.testing.assert_close(simulation.time, reference.time)
    assert simulation.time.dtype == torch.float64
    assert not simulation.diverged().any()


def test_a_step_of_the_mirrored_cartpole_is_the_mirrored_step(cartpole):
    n, g = 4, "reflect-x"
    u, mirror = controls(1, n, nu=1, seed=3)[0], cartpole.robot.actuators
    start = cartpole.sample_initial_state(n, torch.Generator().manual_seed(1))
    image = cartpole.transform_state(start, g)
    both = warp(cartpole.model, 2 * n)
    both.write(None, torch.cat([start.qpos, image.qpos]), torch.cat([start.qvel, image.qvel]))
    both.step(torch.cat([u, mirror(u, g)]), cartpole.substeps)
    stepped, mirrored = both.qpos.double().split(n)
    torch.testing.assert_close(cartpole.robot.map_qpos(stepped, g), mirrored, rtol=1e-4, atol=1e-6)
    stepped, mirrored = both.qvel.double().split(n)
    torch.testing.assert_close(cartpole.robot.map_qvel(stepped, g), mirrored, rtol=1e-4, atol=1e-6)
    assert mirrored.abs().min() > 1e-4


def test_contacts_agree_with_mujoco(model):
    """Standing, sliding, landing and rocking; who meets the ground a step later may differ for a while."""
    reference, simulation = Simulation(model, 4, 1), warp(model, 4)
    qvel = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [-0.5, 0.0, -0.5]])
    for engine in (reference, simulation):
        engine.write(None, torch.zeros(4, 3), qvel)
    for number, u in enumerate(3 * controls(50, 4)):
        for engine in (reference, simulation):
            engine.step(u, 1)
        difference = (state(simulation) - state(reference)).abs().amax(-1)
        if number == 0:
            assert difference.max() < 1e-4
    assert difference.median() < 1e-4 and difference.max() < 1e-2
    assert reference.qvel.abs().amax(-1).min() > 0.01, "none has come to rest"
    assert all(simulation.data(row).ncon for row in range(4)), "on the ground"
    assert int(simulation.num_diverged) == 0


@pytest.mark.parametrize("ids", [torch.tensor([1, 3]), torch.tensor([False, True, False, True])])
def test_step_of_some_rows_leaves_the_others(model, ids):
    simulation, all_of_them = warp(model, 4), warp(model, 4)
    before = run(simulation, controls(5, 4))
    run(all_of_them, controls(5, 4))
    u = controls(1, 4, seed=1)[0]
    u[0] = torch.nan  # of a row that is not stepped
    simulation.step(u, 1, ids)
    all_of_them.step(u)
    assert simulation.time.tolist() == pytest.approx([0.05, 0.055, 0.05, 0.055])
    rows = simulation.save()["rows"]
    assert torch.equal(rows[1::2], all_of_them.save()["rows"][1::2])
    assert torch.equal(simulation.qpos[::2].double(), before[::2, :3])
    assert not simulation.diverged().any()


@pytest.mark.parametrize("each", [False, True], ids=["k rows", "n rows"])
@pytest.mark.parametrize("ids", [None, torch.tensor([2, 0]), torch.tensor([True, False, True])])
@pytest.mark.parametrize("make", [warp, lambda model, n: Simulation(model, n, 1)], ids=["warp", "mujoco"])
def test_write_forgets_the_previous_episode(model, make, ids, each):
    """A used row that is written continues exactly as a new simulation from the same state."""
    used, new = make(model, 3), make(model, 3)
    untouched = run(used, controls(5, 3))[1]
    used.mocap_pos[0] = used.mocap_pos[2] = 7.0
    k = 3 if ids is None or (each and ids.dtype == torch.bool) else 2
    qpos, qvel = torch.randn(k, 3) * 0.1, torch.randn(k, 3)
    for simulation in (used, new):
        simulation.write(ids, qpos, qvel)
    if ids is not None:
        assert torch.equal(used.save()["rows"][1], untouched)
        expected = qpos[ids] if k == 3 else qpos
        assert torch.equal(used.qpos[ids].float(), expected)
    rows = slice(None) if ids is None else ids
    ctrl = controls(5, 3, seed=2)
    assert torch.equal(run(used, ctrl)[rows], run(new, ctrl)[rows])
    assert used.mocap_pos[rows][0, 0].tolist() == [1.0, 2.0, 3.0]


def test_write_sets_mocap_and_time(model):
    simulation, quat = warp(model, 2), torch.tensor([[[0.0, 1.0, 0.0, 0.0]]])
    simulation.write(
        torch.tensor([1]),
        torch.zeros(1, 3),
        torch.zeros(1, 3),
        torch.ones(1, 1, 3),
        quat,
        torch.tensor([1.0]),
    )
    simulation.step(torch.zeros(2, 2))
    assert simulation.mocap_pos[:, 0, 2].tolist() == [3.0, 1.0]
    assert simulation.mocap_quat[1, 0].tolist() == quat[0, 0].tolist()
    assert simulation.time.tolist() == pytest.approx([0.005, 1.005])
    assert simulation.data(1).mocap_pos.tolist() == [[1.0, 1.0, 1.0]]


def test_write_refuses_shapes_and_reports_numbers_that_are_not_finite(model):
    simulation = warp(model, 3)
    for qpos, message in (
        (torch.zeros(1, 3), r"qpos of shape \(2, 3\), got shape \(1, 3\)"),
        (torch.zeros(2, 2), r"got shape \(2, 2\)"),
        (np.zeros((2, 3)), "qpos: expected a tensor, got ndarray"),
    ):
        for ids in (torch.tensor([0, 1]), torch.tensor([True, True, False])):
            with pytest.raises((TypeError, ValueError), match=message):
                simulation.write(ids, qpos, torch.zeros(2, 3))
    qvel = torch.ones(2, 3)
    qvel[1, 2] = torch.inf
    simulation.write(torch.tensor([0, 1]), torch.full((2, 3), 0.1), qvel)
    assert simulation.qpos[:2, 0].tolist() == [pytest.approx(0.1), 0.0]
    assert simulation.save()["rows"].isfinite().all()
    simulation.step(torch.zeros(3, 2), 1, torch.tensor([True, False, False]))
    assert not simulation.diverged().any(), "not stepped, not yet reported"
    simulation.step(torch.zeros(3, 2))
    assert simulation.diverged().tolist() == [False, True, False]
    simulation.step(torch.zeros(3, 2))
    assert not simulation.diverged().any()


def poison_control(simulation, ctrl):
    ctrl[1, 0] = torch.nan


def poison_huge_control(simulation, ctrl):
    ctrl[1, 1] = 1e30


def poison_control_beyond_float32(simulation, ctrl):
    ctrl[1] = 1e300


def poison_velocity(simulation, ctrl):
    simulation.qvel[1, 0] = 1e5


def poison_position(simulation, ctrl):
    simulation.qpos[1, 1] = torch.nan


def poison_far_away(simulation, ctrl):
    simulation.qpos[1, 0] = 1e12


@pytest.mark.parametrize(
    "poison",
    [
        poison_control,
        poison_huge_control,
        poison_control_beyond_float32,
        poison_velocity,
        poison_position,
        poison_far_away,
    ],
)
def test_divergence_is_reported_once_and_stays_in_its_row(model, poison):
    simulation, healthy = warp(model, 3), warp(model, 3)
    ctrl = controls(4, 3).double()
    for u in ctrl[:2]:
        simulation.step(u)
        healthy.step(u)
    assert not simulation.diverged().any()
    bad = ctrl[2].clone()
    poison(simulation, bad)
    assert simulation.step(bad) is True
    healthy.step(ctrl[2])
    assert simulation.diverged().tolist() == [False, True, False]
    for x in (simulation.qpos, simulation.qvel, simulation.time, simulation.ctrl):
        assert not x[1].any()
    assert simulation.save()["rows"].isfinite().all()
    simulation.step(ctrl[3])
    healthy.step(ctrl[3])
    assert not simulation.diverged().any()
    assert (int(simulation.num_diverged), int(simulation.num_overflowed)) == (1, 0)
    others = torch.tensor([0, 2])
    assert torch.equal(simulation.save()["rows"][others], healthy.save()["rows"][others])


def test_max_velocity_is_the_limit(model):
    for limit, expected in ((10.0, True), (30.0, False)):
        simulation = warp(model, 1, max_velocity=limit)
        simulation.qvel[0, 0] = -20.0
        simulation.step(torch.zeros(1, 2))
        assert simulation.diverged().item() is expected


def test_nothing_waits_for_the_device(model, monkeypatch):
    """As far as the CPU shows: no number is handed to the host, and no array of warp's is copied to it."""
    simulation, u = warp(model, 4), controls(1, 4)[0]
    mask, numbers, qpos = torch.tensor([True, False, True, False]), torch.tensor([1, 3]), torch.zeros(4, 3)
    simulation.step(u)
    mass = simulation.expand("body_mass")
    simulation.refresh()
    monkeypatch.setattr(wp.array, "numpy", refused)
    with NoWaits():
        for ids in (None, mask, numbers):
            assert simulation.step(u, 2, ids)
        simulation.write(None, qpos, qpos)
        simulation.write(mask, qpos, qpos, time=torch.zeros(4))
        simulation.write(numbers, qpos[:2], qpos[:2])
        mass[:] *= 2.0
        for ids in (None, mask, numbers):
            simulation.refresh(ids)
        simulation.save()


def test_what_there_is_no_room_for_ends_the_row_and_is_counted(model, capfd):
    """A full table of constraints ends its row; a full pool of contacts ends them all."""
    qpos = torch.zeros(3, 3)
    qpos[:2, 1] = 1.0  # in the air
    full_table, full_pool, enough = warp(model, 3, njmax=2), warp(model, 3, nconmax=1), warp(model, 3)
    for simulation in (full_table, full_pool, enough):
        simulation.write(None, qpos, torch.zeros(3, 3))
        simulation.step(torch.zeros(3, 2))
    assert enough.data(2).ncon == 3
    assert full_table.diverged().tolist() == [False, False, True]
    assert full_table.qvel[2].tolist() == [0.0] * 3 and full_table.qvel[0, 1] != 0
    assert (int(full_table.num_diverged), int(full_table.num_overflowed)) == (1, 1)
    assert not full_pool.diverged().any(), "one world's contacts fit into the pool of three"
    assert not enough.diverged().any()
    full_pool.write(None, torch.zeros(3, 3), torch.zeros(3, 3))
    full_pool.step(torch.zeros(3, 2), 2, torch.tensor([0, 1]))
    assert full_pool.diverged().tolist() == [True, True, False], "of those that were stepped"
    assert (int(full_pool.num_diverged), int(full_pool.num_overflowed)) == (2, 2)
    full_pool.write(None, qpos + 1.0, torch.zeros(3, 3))
    full_pool.step(torch.zeros(3, 2))
    assert not full_pool.diverged().any(), "the flag is of one step"
    assert "overflow" not in capfd.readouterr().out


def test_iterations_of_the_solver_are_no_loss_and_no_message(capfd):
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.iterations = model.opt.ls_iterations = 1
    simulation = warp(model, 2)
    simulation.step(torch.ones(2, 2), 3)
    assert simulation._overflow.all(), "the limit was reached"
    assert not simulation.diverged().any()
    assert "iterations" not in capfd.readouterr().out


def test_room_follows_the_model(model, cartpole):
    assert (warp(model, 1).nconmax, warp(model, 1).njmax) == (CONTACTS, CONSTRAINTS + 2)
    assert (warp(cartpole.model, 1).nconmax, warp(cartpole.model, 1).njmax) == (1, 1)


@pytest.mark.parametrize("name", ["num_envs", "nconmax", "njmax"])
@pytest.mark.parametrize(
    ("value", "error"),
    [(True, TypeError), (1.5, ValueError), ("2", TypeError), (0, ValueError), (2**31, ValueError)],
)
def test_numbers(model, name, value, error):
    with pytest.raises(error, match=rf"{name}: expected a whole number from 1 to \d+, got "):
        WarpSimulation(model, **{"num_envs": 2, "device": "cpu", name: value})


def test_bad_arguments_say_what_is_expected(model):
    for device in ("tpu", "cuda:99", "cpu:1", "cuda: 0"):
        with pytest.raises(ValueError, match=rf"device: expected 'cpu', or 'cuda'.*got '{device}'"):
            WarpSimulation(model, 1, device)
    with pytest.raises(TypeError, match="device: expected str or device, got 0"):
        WarpSimulation(model, 1, 0)
    with pytest.raises(ValueError, match="max_velocity > 0"):
        warp(model, 1, max_velocity=float("nan"))
    with pytest.raises(ValueError, match=r"ctrl of shape \(3, 2\).*got \(3, 1\)"):
        warp(model, 3).step(torch.zeros(3, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda xml: xml.replace("<option", '<option><flag sleep="enable"/></option><option'),
            "never sleep",
        ),
        (
            lambda xml: xml.replace('cone="elliptic"', 'cone="elliptic" solver="PGS"'),
            "mujoco_warp can step.*PGS",
        ),
    ],
)
def test_models_that_it_cannot_step_exactly_are_refused(change, message):
    with pytest.raises(ValueError, match=message + ".*take tasks.simulation.Simulation"):
        warp(mujoco.MjModel.from_xml_string(change(MODEL)), 1)
