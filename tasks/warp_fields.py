"""Model fields with a value per simulation, in mujoco_warp: what domain randomisation writes.

A model of mujoco_warp has its fields once, in arrays with one row that all simulations share. A field that
is to differ gets an array with a row for each, in memory of torch. From some fields MuJoCo derives others,
such as the inverse inertia at rest from the masses; they get rows too before they are computed anew.

Not every field can be given other values. Whether there is any stiffness or damping of tendons, for
instance, mujoco_warp asks once and then leaves out what computes it; and the damping of actuators it adds
to that of the joints, so that the name no longer means what it means in MuJoCo. Such fields are refused.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
from typing import Any

import mujoco
import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.extras import require

require("tasks.warp_simulation", "gpu", {"mujoco": "3.17", "mujoco_warp": "3.17", "warp": "1.19"})

mj: Any = mujoco  # its compiled modules have no type stubs
mjw: Any = importlib.import_module("mujoco_warp")  # by name, for a type checker that has neither
wp: Any = importlib.import_module("warp")
PER_SIMULATION = tuple(
    field.name
    for field in dataclasses.fields(mjw.Model)
    if getattr(field.type, "shape", ())[:1] == ("*",) and hasattr(mj.MjModel, field.name)
)
# What mjw.set_const computes and a step reads.
DERIVED = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0", "eq_data"),
    *("tendon_length0", "tendon_invweight0", "geom_aabb", "geom_rbound"),
)
# Whether there are any is asked when the model is made; of actuators, only for the integrator "discrete".
ASKED_ONCE = {
    "tendon_stiffness": "has_tendon_stiffness",
    "tendon_stiffnesspoly": "has_tendon_stiffness",
    "tendon_damping": "has_tendon_damping",
    "tendon_dampingpoly": "has_tendon_damping",
    "actuator_gainprm": "has_efm_actuator",
    "actuator_biasprm": "has_efm_actuator",
}


class Fields:
    """The fields of a model on a device that have a value per simulation.

    Args:
        model: as MuJoCo has compiled it.
        physics: the same in mujoco_warp (``mjw.put_model``), whose arrays are replaced.
        num_envs: number of simulations n.

    Attributes:
        values: by name, ``(n, ...)`` each, live.
        expanded: names of those that somebody asked for; the others are derived.

    Example:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body>
        ...   <joint/><geom size=".1" mass="2"/></body></worldbody></mujoco>''')
        >>> with wp.ScopedDevice("cpu"):
        ...     fields = Fields(model, mjw.put_model(model), num_envs=3)
        >>> fields.expand("body_mass")[:, 1]
        tensor([2., 2., 2.])
    """

    def __init__(self, model: Any, physics: Any, num_envs: int) -> None:
        self._model, self._physics, self._num_envs = model, physics, num_envs
        self._own: dict[str, Tensor] = {}  # the model's values, one row
        self.values: dict[str, Tensor] = {}
        self.expanded: set[str] = set()

    def expand(self, name: str) -> Tensor:
        """The live values of a field by name.

        Raises:
            ValueError: no field that may differ, or one that mujoco_warp does not read as it is.
        """
        if name not in self.expanded:
            self._check(checks.one_of("field", name, PER_SIMULATION))
            self.expanded.add(name)
        return self._rows(name)

    def derived(self) -> dict[str, Tensor]:
        """Those that ``mjw.set_const`` is about to compute, by name."""
        return {name: self._rows(name) for name in DERIVED if getattr(self._physics, name).size}

    def _check(self, name: str) -> None:
        flag = ASKED_ONCE.get(name)
        if name.startswith("actuator") and self._physics.opt.integrator != mjw.IntegratorType.DISCRETE:
            flag = None
        held = self._own[name] if name in self._own else wp.to_torch(getattr(self._physics, name))
        own = torch.from_numpy(getattr(self._model, name)).to("cpu", held.dtype)
        read = flag is None or getattr(self._physics, flag)
        if not read or not torch.equal(own.flatten(), held.cpu().flatten()):
            raise ValueError(
                f"{name}: expected a field that mujoco_warp reads as it is, got one that it has evaluated "
                "when the model was made; change it in the model, or take tasks.simulation.Simulation"
            )

    def _rows(self, name: str) -> Tensor:
        if name not in self.values:
            array = getattr(self._physics, name)
            own = wp.to_torch(array)
            values = own.repeat(self._num_envs, *[1] * (own.ndim - 1))
            setattr(self._physics, name, wp.from_torch(values, dtype=array.dtype))
            self._own[name], self.values[name] = own, values
        return self.values[name]

    def model_of(self, row: int) -> Any:
        """The model of one simulation, an ``MjModel`` of its own."""
        model = copy.copy(self._model)
        for name, values in self.values.items():
            field = getattr(model, name)
            field[...] = values[row].cpu().numpy().reshape(field.shape)
        return model

    def save(self) -> dict[str, Tensor]:
        """Copies, as ``model.NAME``; of what was derived, as ``derived.NAME``."""
        kinds = {name: "model" if name in self.expanded else "derived" for name in self.values}
        return {f"{kinds[name]}.{name}": x.clone() for name, x in self.values.items()}

    def load(self, saved: dict[str, Tensor]) -> None:
        """Continue from what :meth:`alike` compared; what was not saved returns to the model's values."""
        given = {key.partition(".")[2]: x for key, x in saved.items()}
        for name, x in self.values.items():
            x.copy_(given.get(name, self._own[name]))

    def alike(self, saved: dict[str, Any]) -> dict[str, Tensor]:
        """Own values of the fields that were saved, by the same keys.

        Raises:
            ValueError: a field that cannot be expanded.
        """
        own = {}
        for key in saved:
            kind, _, name = key.partition(".")
            if kind == "model":
                own[key] = self.expand(name)
            elif kind == "derived" and name in DERIVED:
                own[key] = self._rows(name)
        return own
