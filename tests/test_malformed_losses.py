"""Malformed arguments of transforms, losses and assertions are refused, and so are misspelt keywords."""

import functools
import inspect
import math

import pytest
import torch
from torchrl.data import LazyTensorStorage
from torchrl.objectives import ClipPPOLoss, PPOLoss

import tasks
from tests.malformed import (
    Argument,
    array,
    assert_refused,
    choice,
    count,
    each,
    flag,
    function,
    names,
    number,
    optional,
    subject,
    thing,
)
from tests.networks import make_actor, make_batch, make_critic, make_symmetry
from torchrl_sym import (
    MirrorLoss,
    SymmetricClipPPOLoss,
    SymmetryAugment,
    SymmetryOrbit,
    SymmetryReplayBuffer,
    checks,
    testing,
)
from torchrl_sym import representations as r

SYMMETRY, BATCH = make_symmetry("K4"), make_batch()
GROUP = SYMMETRY.group
SIGN = r.pseudoscalar(GROUP)
ENV = tasks.make_env("cartpole", num_envs=16, num_threads=1)
ACTOR, CRITIC = make_actor(), make_critic()

symmetry = thing(SYMMETRY, **{"a mapping": {"action": SIGN}, "a group": GROUP, "a representation": SIGN})
elements = names(["reflect-x", "rot-180"], word="al", beyond=[4], fractions=[0.5])
batch = thing(BATCH, **{"a plain dictionary": dict(BATCH.items()), "an entry": BATCH["observation"]})
actor = thing(ACTOR, **{"a critic": CRITIC, "a network": torch.nn.Linear(4, 3)})
critic = optional(thing(CRITIC, **{"a network": torch.nn.Linear(4, 1)}))
sign = thing(SIGN, **{"a group": GROUP, "a symmetry": SYMMETRY})
of_another = {"of another group": r.polar(make_symmetry("C3").group)}
WORDS = "coeff stop_gradient reduction per_element functional"
PPO = (
    "mirror_coeff elements clip_epsilon entropy_coeff critic_coeff normalize_advantage reduction "
    "clip_value separate_losses value_key"
)

SUBJECTS = [
    subject(
        "SymmetryAugment",
        SymmetryAugment,
        "elements layout when select log_prob_from",
        symmetry=symmetry,
        elements=elements,
        layout=choice("stack"),
        when=choice("extend"),
        select=optional(names(["observation", "action"]).but("one misspelt", "one twice")),
        log_prob_from=optional(actor),
    ),
    subject("augment", SymmetryAugment(SYMMETRY).augment, tensordict=batch.but(**{"one row": BATCH[0]})),
    subject("augment(batch)", SymmetryAugment(SYMMETRY), tensordict=batch),
    subject("SymmetryOrbit", SymmetryOrbit, "elements", symmetry=symmetry, elements=elements),
    subject(
        "SymmetryReplayBuffer",
        functools.partial(SymmetryReplayBuffer, storage=LazyTensorStorage(8)),
        "elements when batch_size prefetch",
        symmetry=symmetry,
        elements=elements,
        when=choice("extend"),
        batch_size=optional(count(4)),
    ),
    subject(
        "MirrorLoss",
        MirrorLoss,
        WORDS,
        actor_network=thing(ACTOR, **{"a network": torch.nn.Linear(4, 3)}),
        symmetry=symmetry,
        coeff=number(0.1),
        stop_gradient=flag(True),
        reduction=optional(choice("sum")),
        per_element=flag(True),
        functional=flag(True),
    ),
    subject(
        "SymmetricClipPPOLoss",
        SymmetricClipPPOLoss,
        PPO,
        actor_network=actor,
        critic_network=critic,
        symmetry=symmetry,
        elements=elements,
        mirror_coeff=number(0.1),
        clip_epsilon=number(0.2),
        entropy_coeff=optional(number(0.2, low=-math.inf)),
        critic_coeff=optional(number(0.2)),
        clip_value=optional(number(0.2)).but("true"),
    ),
    subject(
        "assert_representation", testing.assert_representation, representation=sign, tolerance=number(1e-9)
    ),
    subject(
        "assert_equivariant",
        testing.assert_equivariant,
        module=function(torch.tanh),
        in_rep=sign,
        out_rep=optional(sign.but(**of_another)),
        inputs=optional(array(torch.randn(5, 1))).but(
            "a number", "another size", "one more dimension", **{"too wide": torch.randn(5, 2)}
        ),
        names=optional(names(["left"]).but("one misspelt", "one text")),
        tolerance=number(1e-5),
        seed=count(3, low=0),
    ),
    subject(
        "assert_env_symmetric",
        testing.assert_env_symmetric,
        env=thing(ENV),
        symmetry=Argument(ENV.symmetry, symmetry.wrong),
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("mirror_coef", TypeError, "got 'mirror_coef'; did you mean 'mirror_coeff'"),
        ("clip_epsilom", TypeError, "got 'clip_epsilom'; did you mean 'clip_epsilon'"),
        ("coffee", TypeError, "expected keyword arguments among .*'clip_epsilon'.*, got 'coffee'$"),
        # these are TorchRL's own answers, to names that it has had or has under another method
        ("entropy_coef", TypeError, "'entropy_coef' has been removed"),
        ("critic_coef", TypeError, "'critic_coef' has been removed"),
        ("gamma", TypeError, "make_value_estimator"),
        ("value_key", RuntimeError, "deprecated, use .set_keys"),
    ],
)
def test_keywords_that_nobody_reads(name, error, message):
    with pytest.raises(error, match=message):
        SymmetricClipPPOLoss(ACTOR, CRITIC, symmetry=SYMMETRY, **{name: 0.5})


@pytest.mark.parametrize(
    "keywords",
    [
        {"clip_epsilon": (0.1, 0.3), "clip_value": 0.2},
        {"clip_epsilon": 1, "clip_value": True, "entropy_coeff": {"action": 0.1}, "critic_coeff": 0},
        {"clip_epsilon": torch.tensor(0.2), "entropy_coeff": -0.1, "critic_coeff": None},
        {"functional": False, "log_explained_variance": False, "samples_mc_entropy": 2},
        {"reduction": "none", "loss_critic_type": "l2", "separate_losses": True, "entropy_bonus": False},
        {"normalize_advantage": True, "normalize_advantage_exclude_dims": (), "device": "cpu"},
        {"delay_actor": True, "max_importance_ratio": 2.0},
        {"advantage_key": None, "value_target_key": None, "value_key": None, "gamma": None},
    ],
    ids=lambda keywords: " ".join(keywords),
)
def test_what_ppo_takes_is_taken(keywords):
    ClipPPOLoss(ACTOR, CRITIC, **keywords)
    SymmetricClipPPOLoss(ACTOR, CRITIC, symmetry=SYMMETRY, **keywords)


def test_every_keyword_of_ppo_is_known():
    """Both losses of TorchRL swallow what they do not know; the rest is read off their signatures."""
    known = set(checks.keywords(SymmetricClipPPOLoss))
    for loss in (ClipPPOLoss, PPOLoss):
        named = inspect.signature(loss.__init__).parameters
        assert {name for name in named if name not in ("self", "kwargs")} <= known


def test_networks_by_their_former_names():
    loss = SymmetricClipPPOLoss(actor=ACTOR, critic=CRITIC, symmetry=SYMMETRY)
    assert loss(BATCH)["loss_objective"].isfinite()


def test_subclasses_fix_arguments_and_add_their_own():
    class Fixed(SymmetricClipPPOLoss):
        def __init__(self, *, temperature: float) -> None:
            super().__init__(ACTOR, CRITIC, symmetry=SYMMETRY, clip_epsilon=0.1)
            self.temperature = temperature

    assert Fixed(temperature=2.0).temperature == 2.0
