"""Bridges to where robots are trained today; each imports what it bridges to only where it is used.

* :mod:`~torchrl_sym.bridges.rsl_rl`: a symmetry as rsl_rl's data augmentation function.
* :mod:`~torchrl_sym.bridges.isaac_lab`: a symmetry from the terms of Isaac Lab's observations.
* :mod:`~torchrl_sym.bridges.mjlab`: a symmetry from an mjlab environment, whose terms it knows.
"""
