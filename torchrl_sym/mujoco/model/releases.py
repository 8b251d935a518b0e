"""Where MuJoCo's releases differ, from 3.11 on: asked here once, so that no other file knows of releases.

What only a later release has belongs here too: a function that gives an older model the value which means
"nothing of the kind". Collision asks the model itself, as the simulator of that release does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torchrl_sym.mujoco.model.types import MjModel


def weld_ids(model: MjModel) -> NDArray[np.int32]:
    """For every body the one that moves it, ``(nbody,)``; what nothing moves belongs to the world (0).

    A mocap body moves what is welded to it. Its ``body_weldid`` says so in later releases; in MuJoCo 3.11
    that says that all this is welded to the world.

    Example:
        >>> from torchrl_sym.mujoco.model.types import mj
        >>> model = mj.MjModel.from_xml_string('''<mujoco><worldbody><body mocap="true">
        ...   <body><geom size=".1"/><body><joint/><geom size=".1"/></body></body>
        ... </body></worldbody></mujoco>''')
        >>> weld_ids(model).tolist()
        [0, 1, 1, 3]
    """
    if model.nmocap == 0:
        return model.body_weldid
    root = model.body_rootid  # a mocap body hangs on the world, and is the root of all that hangs on it
    carried = (model.body_weldid == 0) & (model.body_mocapid[root] >= 0)
    return np.where(carried, root, model.body_weldid)
