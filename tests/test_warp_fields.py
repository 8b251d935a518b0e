"""Saving, copying and a model's fields per simulation in the engine on mujoco_warp, run on the CPU."""

import copy
import pickle

import mujoco
import numpy as np
import pytest
import torch

pytest.importorskip(
    "mujoco_warp", reason="needs mujoco_warp: pip install 'torchrl_sym[gpu]'", exc_type=ImportError
)

from tasks.simulation import Simulation
from tasks.warp_fields import DERIVED, PER_SIMULATION
from tests.warp_models import MODEL, controls, run, state, warp


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


def test_save_and_load_continue_bit_for_bit(model):
    ctrl = controls(20, 4)
    simulation, other = warp(model, 4), warp(model, 4)
    simulation.expand("body_mass")[1] *= 2.0  # without refresh
    simulation.expand("geom_friction")[2, :, 0] = 0.1
    run(simulation, ctrl[:10])
    run(other, controls(7, 4, seed=9))
    other.expand("body_inertia")[3] *= 2.0
    other.refresh()
    saved = simulation.save()
    assert saved.keys() == {"rows", "model.body_mass", "model.geom_friction"}
    expected = run(simulation, ctrl[10:])
    other.load(saved)
    assert torch.equal(run(other, ctrl[10:]), expected)
    assert not torch.equal(saved["rows"], expected), "save() must copy"
    for engine in (warp(model, 3), Simulation(model, 4, 1)):
        with pytest.raises(ValueError, match="expected saved rows of shape"):
            engine.load(saved)


@pytest.mark.parametrize(
    "twin", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"]
)
def test_copies_continue_bit_for_bit_in_memory_of_their_own(model, twin):
    simulation = warp(model, 2, nconmax=5, njmax=30, max_velocity=50.0)
    simulation.expand("body_mass")[1] *= 2.0
    simulation.refresh()
    ctrl = controls(6, 2)
    ctrl[2, 0] = torch.nan
    run(simulation, ctrl[:3])
    other = twin(simulation)
    assert (other.nconmax, other.njmax, other.max_velocity) == (5, 30, 50.0)
    assert other.diverged().tolist() == [True, False] and int(other.num_diverged) == 1
    assert torch.equal(run(other, ctrl[3:]), run(simulation, ctrl[3:]))
    before = simulation.qpos.clone()
    other.qpos.zero_()
    assert torch.equal(simulation.qpos, before)


def test_expanded_fields_act_per_row_as_in_mujoco(model):
    reference, simulation = Simulation(model, 3, 1), warp(model, 3)
    for engine in (reference, simulation):
        assert engine.expand("geom_friction") is engine.expand("geom_friction")
        engine.expand("geom_friction")[1, :, 0] = 0.2
        engine.expand("body_mass")[2] *= 3.0
        engine.refresh()
        engine.write(None, torch.zeros(3, 3), torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3))
        run(engine, torch.zeros(20, 3, 2))
        assert (engine.qpos[0] - engine.qpos[1]).abs().max() > 1e-3
        assert (engine.qpos[0] - engine.qpos[2]).abs().max() > 1e-5
    torch.testing.assert_close(state(simulation), state(reference), rtol=0, atol=1e-3)
    derived = simulation.save()
    for name in ("body_invweight0", "dof_invweight0", "body_subtreemass", "actuator_acc0"):
        theirs = [getattr(reference._batch.get_model(row), name) for row in range(3)]
        ours = derived[f"derived.{name}"].double()
        torch.testing.assert_close(ours, torch.from_numpy(np.stack(theirs)), rtol=1e-4, atol=1e-5)


def test_refresh_of_some_rows_leaves_the_others(model):
    simulation = warp(model, 3)
    for name in ("body_mass", "body_inertia"):
        simulation.expand(name)[:] *= 2.0
    before = simulation.save()
    simulation.refresh(torch.tensor([0, 2]))
    derived = simulation.save()["derived.dof_invweight0"]
    own = torch.from_numpy(model.dof_invweight0).float()
    assert torch.equal(derived[1], own)
    torch.testing.assert_close(derived[::2], (own / 2).expand(2, 3), rtol=1e-4, atol=0)
    assert torch.equal(simulation.save()["rows"], before["rows"])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("body_masss", "field: expected one of .*'body_masss'; .*'body_mass'"),
        ("opt.gravity", "field: expected one of"),
        ("tendon_damping", "tendon_damping: expected a field that mujoco_warp reads as it is"),
        ("dof_damping", "dof_damping: expected a field that mujoco_warp reads as it is"),
    ],
)
def test_fields_that_would_be_ignored_or_wrong_are_refused(name, message):
    xml = MODEL.replace('<motor joint="hinge"', '<motor joint="hinge" damping="0.5"')
    simulation = warp(mujoco.MjModel.from_xml_string(xml), 2)
    assert simulation.expand("dof_armature").shape == (2, 3)
    with pytest.raises(ValueError, match=message):
        simulation.expand(name)


def test_what_is_derived_can_be_expanded(model):
    assert set(DERIVED) < set(PER_SIMULATION)
    simulation = warp(model, 2)
    simulation.expand("body_mass")[1] *= 2
    simulation.refresh()
    assert simulation.expand("body_subtreemass")[1, 0] == 2 * simulation.expand("body_subtreemass")[0, 0]
    assert "model.body_subtreemass" in simulation.save()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda saved: saved.pop("rows"), r"expected saved with .*'rows'\], got "),
        (lambda saved: saved.update(rows=None), "expected saved rows to be a Tensor, got NoneType"),
        (lambda saved: saved.update(rows=saved["rows"].float()), "torch.float64, got .* and torch.float32"),
        (lambda saved: saved["rows"].fill_(torch.nan), "expected finite saved rows"),
        (lambda saved: saved.update({"model.body_mass": torch.ones(4)}), r"body_mass of shape \(2, 3\)"),
        (lambda saved: saved.update({"model.nothing": torch.ones(1)}), "expected one of .*got 'nothing'"),
        (lambda saved: saved.update({"derived.geom_size": torch.ones(1)}), r"got \['derived.geom_size', "),
        (lambda saved: saved.update(columns=torch.ones(1)), r"got \['columns', "),
    ],
)  # fmt: skip
def test_what_was_not_saved_is_not_loaded(model, change, message):
    simulation = warp(model, 2)
    simulation.expand("body_mass")
    before, saved = simulation.save(), simulation.save()
    change(saved)
    with pytest.raises(ValueError, match=message):
        simulation.load(saved)
    assert torch.equal(simulation.save()["rows"], before["rows"])


def test_data_is_a_copy_with_derived_fields(model):
    simulation = warp(model, 2)
    simulation.expand("body_mass")[1, 2] = 12.0
    simulation.write(None, torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]), torch.zeros(2, 3))
    data = simulation.data(1)
    np.testing.assert_allclose(data.xpos[2], [2.0, 0.0, 1.149], atol=1e-6)
    assert data.qfrc_bias[1] == pytest.approx(12 * 9.81)
    data.qpos[0] = 5.0
    assert simulation.qpos[1, 0] == 2.0 and model.body_mass[2] == 3.0
