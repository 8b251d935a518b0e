"""What observation managers of Isaac Lab and mjlab show, and how they compute, without their simulators."""

from types import SimpleNamespace

import torch

from tests.point_groups import random


def cfg(**settings):
    defaults = {"history_length": 0, "flatten_history_dim": True, "clip": None, "scale": None}
    return SimpleNamespace(**defaults | settings)


class Manager:
    """Has what both observation managers have, and computes as they do, from given frames."""

    def __init__(self, groups, frame, concatenate=True, dim=-1):
        self.groups, self.frame = groups, frame
        self.group_obs_concatenate = dict.fromkeys(groups, concatenate)
        self._group_obs_concatenate_dim = dict.fromkeys(groups, dim + 1 if dim >= 0 else dim)
        self.active_terms = {group: list(terms) for group, terms in groups.items()}
        self._group_obs_term_cfgs = {group: list(terms.values()) for group, terms in groups.items()}
        values = self.compute(
            {name: random(9, 1, *rho.event_shape) for name, rho in frame.items()}, raw=True
        )
        self.group_obs_term_dim = {g: [x.shape[1:] for x in terms.values()] for g, terms in values.items()}

    def compute(self, frames, raw=False):
        """Observations ``[B]`` from frames of terms, ``(T, B, ...)``, the oldest first."""
        out = {}
        for group, terms in self.groups.items():
            values = {}
            for name, term in terms.items():
                x = frames[name]
                x = x.clip(*term.clip) if term.clip else x
                x = x * torch.as_tensor(term.scale) if term.scale is not None else x
                length = term.history_length
                history = x[-length:].movedim(0, 1)  # (B, T, ...)
                flat = history.reshape(x.shape[1], -1) if term.flatten_history_dim else history
                values[name] = flat if length else x[-1]
            if self.group_obs_concatenate[group] and not raw:
                values = torch.cat(list(values.values()), self._group_obs_concatenate_dim[group])
            out[group] = values
        return out
