"""Which transforms an environment may have: judged by trying them out, wherever they are."""

import random

import numpy as np
import pytest
import torch
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    CatFrames,
    CatTensors,
    ClipTransform,
    Compose,
    DoubleToFloat,
    EnvBase,
    ExcludeTransform,
    FlattenObservation,
    FrameSkipTransform,
    InitTracker,
    NoopResetEnv,
    ObservationNorm,
    ParallelEnv,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    Timer,
    TrajCounter,
    Transform,
    TransformedEnv,
    UnsqueezeTransform,
    VecNorm,
    VecNormV2,
)

from torchrl_sym import PointGroup, SymmetricVecNorm, Symmetry
from torchrl_sym.environments.inside import transforms_of
from torchrl_sym.representations import polar, scalar, signed_permutation

pytestmark = [
    pytest.mark.filterwarnings("ignore:Support of .*VecNorm"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
    pytest.mark.filterwarnings("error:.*cannot be tried out"),
]

GROUP = PointGroup.reflection("y")
KNEES = signed_permutation(GROUP, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
BODY = polar(GROUP) + KNEES  # x, y, z, left, right
SYMMETRY = Symmetry(GROUP, {"observation": BODY, "action": KNEES})
TWICE = Symmetry(GROUP, {"observation": BODY * 2, "action": KNEES})
SPREAD = torch.tensor([3.0, 1, 2, 4, 4])  # that commutes
RUNNING = (VecNorm, VecNormV2)


class Robot(EnvBase):
    """Velocity and knees, apart or as one entry."""

    def __init__(self, apart=False, batch_size=(2,), action=None):
        super().__init__(batch_size=batch_size)
        sizes = {"velocity": 3, "knees": 2} if apart else {"observation": 5}
        self.observation_spec = Composite(
            {key: Unbounded((*batch_size, d), dtype=torch.float64) for key, d in sizes.items()},
            shape=batch_size,
        )
        self.action_spec = Bounded(-1, 1, (*batch_size, 2)) if action is None else action
        self.reward_spec = Unbounded((*batch_size, 1))

    def _reset(self, tensordict=None, **kwargs):
        return self.observation_spec.rand()

    def _step(self, tensordict):
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self.observation_spec.rand().update({"reward": done + 1.0, "done": done})

    def _set_seed(self, seed):
        pass


def robot(*transforms, **kwargs):
    return TransformedEnv(Robot(**kwargs), Compose(*transforms))


def cat(out="observation", keep=False):
    return CatTensors(in_keys=["velocity", "knees"], out_key=out, sort=False, del_keys=not keep)


def norm(loc=0.0, scale=1.0, key="observation"):
    loc, scale = torch.as_tensor(loc), torch.as_tensor(scale)
    return ObservationNorm(loc=loc, scale=scale, in_keys=[key], standard_normal=True)


class Plain(Transform):
    """A user's transform of the observation, of one line."""

    def __init__(self, function):
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.function = function

    def _apply_transform(self, x):
        return self.function(x)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)


class RunningMean(Plain):
    """A user's normaliser; ``average`` makes it symmetric."""

    def __init__(self, average):
        super().__init__(self._normalise)
        self.register_buffer("mean", torch.zeros(5, dtype=torch.float64))
        self.average, self.calls = average, 0

    def _normalise(self, x):
        self.calls += 1
        self.mean += (x.reshape(-1, 5).mean(0) - self.mean) / self.calls
        return x - (BODY.orbit(self.mean).mean(0) if self.average else self.mean)


class Away(Transform):
    """Cannot be used away from its environment."""

    def _call(self, next_tensordict):
        self.parent.base_env.secret  # noqa: B018
        return next_tensordict


def noise(x):
    return x + torch.randn_like(x)


def shapes():
    return UnsqueezeTransform(-2, in_keys=["observation"]), FlattenObservation(
        -2, -1, in_keys=["observation"]
    )


def apart(*transforms):
    return robot(*transforms, apart=True)


def renamed(*transforms):
    return apart(cat("raw"), *transforms, RenameTransform(["raw"], ["observation"]))


PARTS = Symmetry(GROUP, {"velocity": polar(GROUP), "knees": KNEES})
OFF = [0, 0.1, 0, 0, 0]
RIGHT = {
    "counters": lambda: robot(RewardSum(), StepCounter(), InitTracker(), Timer(), TrajCounter()),
    "of the reward": lambda: robot(VecNormV2(["reward"]), VecNorm(["reward"])),
    "constants that commute": lambda: robot(norm([1, 0, 2, 0.5, 0.5], SPREAD)),
    "a factor": lambda: robot(ObservationNorm(loc=0.0, scale=2.0, in_keys=["observation"])),
    "two that cancel": lambda: robot(norm([0, 1.0, 0, 0, 0]), norm([0, -1.0, 0, 0, 0])),
    "cat": lambda: apart(cat(), DoubleToFloat()),
    "of parts": lambda: apart(norm([1, 0, 0], [1, 2, 3], "velocity"), norm(2.0, 3.0, "knees"), cat()),
    "rename": lambda: renamed(),
    "shapes": lambda: robot(*shapes()),
    "exclude": lambda: apart(cat(keep=True), ExcludeTransform("velocity", "knees")),
    "ours": lambda: robot(SymmetricVecNorm(["observation"], symmetry=SYMMETRY)),
    "ours of parts": lambda: apart(SymmetricVecNorm(["velocity", "knees"], symmetry=PARTS), cat()),
    "clip": lambda: robot(ClipTransform(in_keys=["observation"], low=-2.0, high=2.0)),
    "wide on one side, where that is right": lambda: robot(
        Plain(lambda x: x.maximum(-torch.tensor([1, 2, 0, 3, 3])).minimum(torch.tensor([5, 2, 9, 4, 4])))
    ),
    "a user's own": lambda: robot(Plain(torch.tanh)),
    "a user's own, mixing": lambda: robot(Plain(lambda x: x * x.norm(dim=-1, keepdim=True))),
    "a user's own normaliser": lambda: robot(RunningMean(average=True)),
    "a function": lambda: Robot().append_transform(lambda td: td.set("observation", -td["observation"])),
    "noise": lambda: robot(Plain(noise)),
    "noise twice": lambda: robot(Plain(noise), norm(0.0, SPREAD), Plain(noise)),
    "a sign": lambda: robot(Plain(torch.sign)),
    "a clip that nearly everything exceeds": lambda: robot(
        ClipTransform(in_keys=["observation"], low=-0.01, high=0.01)
    ),
    "a dead zone": lambda: robot(Plain(lambda x: torch.where(x.abs() > 5, x, torch.zeros_like(x)))),
    "frames skipped": lambda: robot(FrameSkipTransform(2), NoopResetEnv(3), batch_size=()),
}

WRONG = {
    "measured constants": ("ObservationNorm", lambda: robot(norm(OFF))),
    "unequal scales": ("ObservationNorm", lambda: robot(norm(0.0, [1, 1, 1, 1, 1.2]))),
    "constants, cat": ("ObservationNorm", lambda: apart(norm([0, 0.1, 0], 1.0, "velocity"), cat())),
    "constants, rename": ("ObservationNorm", lambda: renamed(norm(OFF, 1.0, "raw"))),
    "two transformed environments": (
        "VecNormV2",
        lambda: TransformedEnv(apart(VecNormV2(["velocity"])), cat(), auto_unwrap=False),
    ),
    "wide on one side": ("Plain", lambda: robot(Plain(lambda x: x.clamp(-5, 9)))),
    "a user's own": ("Plain", lambda: robot(Plain(lambda x: x + torch.arange(5)))),
    "a user's own, mixing": ("Plain", lambda: robot(Plain(lambda x: x.cumsum(-1)))),
    "a user's own normaliser": ("RunningMean", lambda: robot(RunningMean(average=False))),
    "a function": (
        "Callable",
        lambda: Robot().append_transform(lambda td: td.set("observation", td["observation"] + 1)),
    ),
    "between noise": (
        "ObservationNorm",
        lambda: robot(Plain(noise), StepCounter(), norm(OFF), RewardSum(), Plain(noise)),
    ),
    "running, between noise": (
        "VecNormV2",
        lambda: robot(Plain(noise), VecNormV2(["observation"]), Plain(noise)),
    ),
    "behind noise": ("ObservationNorm", lambda: robot(Plain(noise), norm(OFF))),
    "nested": ("ObservationNorm", lambda: robot(StepCounter(), Compose(Compose(norm(OFF))))),
}
for kind in RUNNING:
    name = kind.__name__
    WRONG |= {
        name: (name, lambda kind=kind: robot(kind(["observation"]))),
        f"{name}, cat": (name, lambda kind=kind: apart(kind(["velocity", "knees"]), cat())),
        f"cat, {name}, rename": (name, lambda kind=kind: renamed(kind(["raw"]))),
    }


@pytest.mark.parametrize("make", RIGHT.values(), ids=RIGHT)
def test_what_is_right_is_accepted(make):
    SYMMETRY.check_specs(make())


@pytest.mark.parametrize(("name", "make"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_refused_by_name(name, make):
    with pytest.raises(
        ValueError, match=rf"{name}.* does not commute .* under 'reflect-y', entry \d of '\w+'"
    ):
        SYMMETRY.check_specs(make())


def test_the_message_says_which_entry_and_what_to_do():
    with pytest.raises(ValueError) as error:
        SYMMETRY.check_specs(robot(StepCounter(), norm([0, 0.1, 0, 0, 0]), RewardSum()))
    message = str(error.value)
    assert message.startswith(
        "ObservationNorm does not commute with the symmetry: for the image of a state"
    )
    assert "entry 1 of 'observation'" in message
    assert "use SymmetricVecNorm" in message
    assert "StepCounter" not in message


def test_frames_are_followed_one_by_one():
    def frames(*before):
        return robot(*before, CatFrames(2, -1, in_keys=["observation"], padding="constant"))

    TWICE.check_specs(frames())
    TWICE.check_specs(frames(norm([1, 0, 2, 0.5, 0.5], SPREAD)))
    with pytest.raises(ValueError, match="VecNormV2 does not commute"):
        TWICE.check_specs(frames(VecNormV2(["observation"])))
    swapped = Symmetry(GROUP, {"observation": BODY + scalar(GROUP) * 5, "action": KNEES})
    with pytest.raises(ValueError, match="CatFrames does not commute"):  # one frame is declared otherwise
        swapped.check_specs(frames())


def test_entries_are_followed_to_another_order():
    order = [3, 4, 0, 1, 2]
    moved = Symmetry(GROUP, {"observation": KNEES + polar(GROUP), "action": KNEES})
    moved.check_specs(robot(Plain(lambda x: x[..., order])))
    with pytest.raises(ValueError, match="ObservationNorm does not commute"):
        moved.check_specs(robot(norm([0, 0.1, 0, 0, 0]), Plain(lambda x: x[..., order])))


def test_results_that_are_no_numbers_agree_with_one_another():
    SYMMETRY.check_specs(robot(Plain(lambda x: (20 - x.abs()).sqrt() * x.sign())))


def test_groups_that_mix_entries():
    group = PointGroup.rotation(3)
    symmetry = Symmetry(
        group, {"observation": polar(group) + scalar(group) * 2, "action": scalar(group) * 2}
    )
    symmetry.check_specs(robot(norm([0, 0, 1, 2, 3], [2, 2, 3, 4, 5])))
    with pytest.raises(ValueError, match=r"under 'rot-120', entry [01] of"):
        symmetry.check_specs(robot(norm(0.0, [2, 3, 3, 4, 5])))


def test_actions_on_their_way_in():
    def scaled(loc, scale):
        inverse = {"in_keys_inv": ["action"], "out_keys_inv": ["action"]}
        action = Unbounded((2, 2))
        return robot(
            ObservationNorm(loc=loc, scale=torch.tensor(scale), in_keys=[], **inverse), action=action
        )

    SYMMETRY.check_specs(scaled(0.5, [2.0, 2.0]))
    with pytest.raises(ValueError, match="for the image of an action under 'reflect-y'"):
        SYMMETRY.check_specs(scaled(0.0, [2.0, 3.0]))


def plain_worker():
    return robot(VecNormV2(["velocity"]), cat("raw"), apart=True, batch_size=())


def right_worker():
    return robot(cat("raw"), RewardSum(), apart=True, batch_size=())


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
def test_inside_workers(kind):
    """Under a rename outside of them, which the search has to follow inwards."""

    def batch(*makers):
        return TransformedEnv(kind(len(makers), list(makers)), RenameTransform(["raw"], ["observation"]))

    SYMMETRY.check_specs(batch(right_worker, right_worker))
    for makers in ([plain_worker, plain_worker], [right_worker, plain_worker]):
        with pytest.raises(ValueError, match="VecNormV2 does not commute"):
            SYMMETRY.check_specs(batch(*makers))
    env = batch(right_worker, right_worker)
    assert [type(t) for t in transforms_of(env)] == [CatTensors, RewardSum, RenameTransform]
    env.close(raise_if_closed=False)


def test_nothing_notices():
    made = []

    def worker():
        made.append(robot(VecNormV2(["reward"]), Plain(noise), batch_size=()))
        torch.rand(3), np.random.rand(), random.random()
        return made[-1]

    running = RunningMean(average=True)
    env = robot(running, VecNormV2(["reward"]), SymmetricVecNorm(["observation"], symmetry=SYMMETRY))
    env.rollout(4)
    parallel = ParallelEnv(2, worker)
    made.clear()
    before = (running.calls, running.mean.clone(), env.transform.state_dict())
    torch.manual_seed(0), np.random.seed(0), random.seed(0)
    numbers = torch.rand(2), np.random.rand(), random.random()
    torch.manual_seed(0), np.random.seed(0), random.seed(0)
    SYMMETRY.check_specs(env)
    SYMMETRY.check_specs(parallel)
    assert (torch.rand(2), np.random.rand(), random.random())[1:] == numbers[1:]
    torch.manual_seed(0)
    assert torch.equal(torch.rand(2), numbers[0])
    assert running.calls == before[0]
    assert torch.equal(running.mean, before[1])
    for key, value in env.transform.state_dict().items():
        torch.testing.assert_close(value, before[2][key])
    assert env.transform[0].parent is not None
    env.rollout(2)


def test_what_cannot_be_tried_out():
    with pytest.warns(UserWarning, match="Away cannot be tried out"):
        SYMMETRY.check_specs(robot(Away()))
    with pytest.raises(ValueError, match="ObservationNorm does not commute"), pytest.warns(UserWarning):
        SYMMETRY.check_specs(robot(Away(), norm([0, 0.1, 0, 0, 0])))
    with pytest.raises(RuntimeError, match="call the init_stats method"):  # TorchRL's own
        SYMMETRY.check_specs(robot(ObservationNorm(in_keys=["observation"])))


def test_mixed_entries_of_which_nothing_is_known():
    """Of a user's own features nobody knows how what they are made of transforms."""

    class Features(Transform):
        def __init__(self):
            super().__init__(in_keys=["velocity", "knees"], out_keys=["observation"])

        def _call(self, td):
            body = torch.cat([td["velocity"], td["knees"]], -1)
            return td.set("observation", body @ torch.arange(25.0, dtype=torch.float64).reshape(5, 5))

        def _reset(self, td, reset):
            return self._call(reset)

        def transform_observation_spec(self, spec):
            spec["observation"] = Unbounded((2, 5), dtype=torch.float64)
            return spec

    def declared():
        return Symmetry(GROUP, {"observation": BODY, "action": KNEES}, strict=False)

    declared().check_specs(robot(Features(), apart=True))
    for kind in RUNNING:
        with pytest.raises(
            ValueError, match=rf"{kind.__name__} keeps statistics of each entry of \['knees'"
        ):
            declared().check_specs(robot(kind(["velocity", "knees"]), Features(), apart=True))
