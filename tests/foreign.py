"""What every simulator behind a wrapper of TorchRL has to satisfy, once its symmetry is declared."""

import torch

from torchrl_sym import SymmetricClipPPOLoss
from torchrl_sym.recipes import PPOConfig
from torchrl_sym.recipes.networks import make_networks


def assert_loss_takes_copies(env, symmetry, steps=6, **keys):
    """A batch of an environment, and its copies, in the loss; the policy is the one that made the batch.

    So what the copies' ratios say is how far this policy is from symmetric, and nothing else: the mean of
    log pi(a|s) - log pi(K_g a|L_g s), computed here by the actor itself.
    """
    symmetry.check_specs(env)
    actor, critic = make_networks(PPOConfig(**keys), env, symmetry)
    with torch.no_grad():
        data = env.rollout(steps, actor, break_when_any_done=False).reshape(-1)
        images = [actor.log_prob(symmetry(data, g)) for g in symmetry.group.names]
    data["advantage"], data["value_target"] = torch.randn(2, *data.shape, 1)
    out = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(data)
    assert all(value.isfinite().all() for value in out.values())
    change = torch.stack([(data["action_log_prob"] - image).mean() for image in images])
    torch.testing.assert_close(out["kl_approx_sym"], change, rtol=1e-4, atol=1e-5)
    assert out["kl_approx"].abs() < 1e-5 and (out["kl_approx_sym"][1:].abs() > 1e-3).all()
