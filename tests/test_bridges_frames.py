"""Frames of a model: what an element does to vectors and rays in them, however they are turned."""

import mujoco
import pytest
import torch

from torchrl_sym import PointGroup
from torchrl_sym.bridges.frames import frame_maps, places, rays, refuse_turned_yaw
from torchrl_sym.mujoco import derive
from torchrl_sym.representations import points

K4, C4, MIRROR = PointGroup.klein_four(), PointGroup.rotation(4), PointGroup.reflection("y")
DOWN = torch.tensor([0.0, 0.0, -1.0])


def robot(group: PointGroup, base: str = "1 0 0 0", feet: tuple[str, ...] = ("0 0 0",) * 4):
    """A free base on four sliding legs, with frames that may be turned any way."""
    legs = "".join(
        f'<body name="leg{i}" pos="{x} {y} 0"><joint type="slide"/><geom size=".1"/>'
        f'<site name="foot{i}" euler="{euler}"/></body>'
        for i, ((x, y), euler) in enumerate(zip([(1, 1), (-1, 1), (-1, -1), (1, -1)], feet, strict=True))
    )
    return derive(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler angle="degree"/><worldbody><body name="base"><freejoint/><geom size=".2"/>'
            f'<body name="inner" quat="{base}"><geom size=".1" mass=".1"/></body>{legs}'
            "</body></worldbody></mujoco>"
        ),
        group,
    )


def test_an_upright_frame_is_mapped_by_the_group_itself():
    torch.testing.assert_close(frame_maps(robot(K4), "body", ["base"])[:, 0], K4.matrices)


STRAIGHT, TURNED = ("0 0 0",) * 4, ("0 0 30", "0 90 0", "180 0 0", "0 0 -50")


@pytest.mark.parametrize("align", ["base", "world", "yaw"])
@pytest.mark.parametrize("group", [K4, C4], ids=["K4", "C4"])
def test_the_maps_of_turned_feet_are_the_same_in_every_state(group, align):
    """B'(g q)^T R B(q) at a random state, with another turn of every foot."""
    group = K4 if align == "yaw" else group  # turns of the x axis are refused, see below
    quadruped = robot(group, feet=STRAIGHT if align == "yaw" else TURNED)
    names = [f"foot{i}" for i in range(4)]
    maps = frame_maps(quadruped, "site", names, align)
    generator = torch.Generator().manual_seed(0)
    qpos = torch.randn(quadruped.model.nq, generator=generator, dtype=torch.float64)
    qpos[3:7] = torch.tensor([1.0, 0.2, -0.1, 0.3])
    qpos[3:7] /= qpos[3:7].norm()
    for g in range(group.order):
        here, there = (_frames(quadruped.model, quadruped.map_qpos(qpos, h), align) for h in (0, g))
        for f, name in enumerate(names):
            image = quadruped.table("site", g)[name]
            expected = there[image].T @ group.matrices[g] @ here[name]
            torch.testing.assert_close(maps[g, f], expected, rtol=0, atol=1e-9)


def test_a_yaw_that_becomes_that_of_another_axis_is_refused():
    with pytest.raises(ValueError, match="'rot-90' turns the x axis of foot0"):
        refuse_turned_yaw(robot(C4), "site", ["foot0", "foot1", "foot2", "foot3"])
    refuse_turned_yaw(robot(K4), "site", ["foot0", "foot1", "foot2", "foot3"])


def _frames(model, qpos, align):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    found = {}
    for i in range(4):
        matrix = torch.as_tensor(data.site(f"foot{i}").xmat.copy()).view(3, 3)
        yaw = torch.atan2(matrix[1, 0], matrix[0, 0])
        turn = torch.tensor([[yaw.cos(), -yaw.sin(), 0], [yaw.sin(), yaw.cos(), 0], [0, 0, 1]])
        found[f"foot{i}"] = {"base": matrix, "yaw": turn.double(), "world": torch.eye(3).double()}[align]
    return found


def tables(quadruped, kind):
    return [quadruped.table(kind, g) for g in range(quadruped.group.order)]


def test_a_grid_of_rays_is_a_height_map():
    grid = torch.cartesian_prod(torch.linspace(-0.8, 0.8, 5), torch.linspace(-0.5, 0.5, 3))
    starts = torch.cat([grid, torch.zeros(15, 1)], -1)
    quadruped = robot(K4)
    frames = places(quadruped, ["base"], tables(quadruped, "body"))
    scan = rays(frames, frame_maps(quadruped, "body", ["base"]), starts, DOWN.expand(15, 3))
    assert torch.equal(scan.matrices, points(K4, grid).matrices)


@pytest.mark.parametrize("group", [K4, C4], ids=["K4", "C4"])
@pytest.mark.parametrize("feet", [("0 0 0",) * 4, ("0 0 90", "0 0 0", "0 0 -90", "0 0 180")])
def test_rays_of_several_feet_go_where_their_points_go(group, feet):
    """Compared with the places of the rays in the world, whatever the frames of the feet."""
    quadruped, names = robot(group, feet=feet), [f"foot{i}" for i in range(4)]
    ring = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [-0.1, 0.0, 0.0], [0.0, -0.1, 0.0]])
    frames = places(quadruped, names, tables(quadruped, "site"))
    scan = rays(frames, frame_maps(quadruped, "site", names), ring, DOWN.expand(4, 3))

    data = mujoco.MjData(quadruped.model)
    mujoco.mj_kinematics(quadruped.model, data)
    world = [
        torch.as_tensor(data.site(name).xpos)
        + ring.double() @ torch.as_tensor(data.site(name).xmat).view(3, 3).T
        for name in names
    ]
    assert torch.equal(scan.matrices, points(group, torch.cat(world)[:, :2]).matrices)


def test_rays_that_are_not_carried_to_rays_are_refused():
    quadruped = robot(MIRROR)
    frames = places(quadruped, ["base"], tables(quadruped, "body"))
    maps = frame_maps(quadruped, "body", ["base"])
    sideways = torch.tensor([[0.0, 0.5, -1.0]])
    for starts, directions in [
        (torch.tensor([[0.2, 0.1, 0.0]]), DOWN[None]),
        (torch.zeros(1, 3), sideways),
    ]:
        with pytest.raises(ValueError, match="'reflect-y' carries the ray from"):
            rays(frames, maps, starts, directions)


def test_bodies_that_go_elsewhere_are_refused():
    quadruped = robot(K4)
    with pytest.raises(
        ValueError, match=r"'reflect-x' carries leg0 .leg1., leg3 .leg2. to one that is not among"
    ):
        places(quadruped, ["leg0", "leg3"], tables(quadruped, "body"))
    with pytest.raises(ValueError, match="nobody"):
        places(quadruped, ["nobody"], tables(quadruped, "body"))
