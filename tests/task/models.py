"""Small models whose forces can be worked out by hand."""


def link(name, mass, x=0.0, size=0.02):
    """A cube of `size` [m] whose centre is at x [m]."""
    moment = mass * size**2 / 6  # of a cube, about each axis
    return (
        f'<link name="{name}"><inertial><origin xyz="{x} 0 0"/><mass value="{mass}"/><inertia ixx="{moment}" '
        f'iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(name, parent, child, x=0.0, kind="revolute", axis="0 1 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="50" velocity="5"/></joint>'
    )


def urdf(folder, *parts):
    file = folder / "model.urdf"
    file.write_text(f'<robot name="model">{"".join(parts)}</robot>')
    return file


def arm(folder):
    """A horizontal arm: 1 kg, 0.5 m from the shoulder, and 0.5 kg welded on at 1 m."""
    return urdf(
        folder,
        link("base", 1.0),
        link("arm", 1.0, x=0.5),
        link("tip", 0.5),
        joint("shoulder", "base", "arm"),
        joint("weld", "arm", "tip", x=1.0, kind="fixed"),
    )


def two_wheels(folder):
    return urdf(
        folder,
        link("base", 1.0),
        link("left", 0.2, x=0.05),
        link("right", 0.2, x=0.05),
        joint("left_joint", "base", "left", axis="0 0 1"),
        joint("right_joint", "base", "right", x=0.2, axis="0 0 1"),
    )


def cart(folder, contact=""):
    """A cart of 4.8 kg on two wheels of 0.1 m, its mass below their axle; `contact` is XML of the wheels."""
    wheel = (
        '<link name="{name}"><inertial><mass value="0.4"/>'
        '<inertia ixx="0.0011" iyy="0.002" izz="0.0011" ixy="0" ixz="0" iyz="0"/></inertial>'
        '<collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.1" length="0.03"/></geometry>'
        '</collision><contact><lateral_friction value="1"/>{contact}</contact></link>'
    )
    hinge = (
        '<joint name="{name}" type="continuous"><parent link="body"/><child link="{name}_wheel"/>'
        '<origin xyz="0 {y} 0"/><axis xyz="0 1 0"/><limit effort="4" velocity="30"/></joint>'
    )
    body = (
        '<link name="body"><inertial><origin xyz="0 0 -0.05"/><mass value="4"/>'
        '<inertia ixx="0.08" iyy="0.07" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    return urdf(
        folder,
        body,
        wheel.format(name="left_wheel", contact=contact),
        wheel.format(name="right_wheel", contact=contact),
        hinge.format(name="left", y=0.15),
        hinge.format(name="right", y=-0.15),
    )
