"""Whether an environment fits a symmetry: its sizes, its boxes and its transforms.

- ``inside``: what an environment is made of, also in its workers;
- ``specs``: sizes and boxes of observations and actions;
- ``playback``, ``trial``, ``probing``: whether transforms commute with the group, found by trying them out.

Users ask through :meth:`torchrl_sym.Symmetry.check_specs`.
"""
