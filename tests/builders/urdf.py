"""URDF files of a drawer, a laptop and a cabinet as in PartNet-Mobility, with their meshes."""

from pathlib import Path

import trimesh

DRAWER_M = (0.30, 0.30, 0.20)  # outside of the cabinet: x, y, z
LAPTOP_AXIS_M = (0.0, 0.10, 0.02)


def box_at(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(extents).apply_translation(centre)


def drawer_shells() -> list[trimesh.Trimesh]:
    """The tray and its handle, two shells that do not touch; it opens towards -y."""
    return [box_at((0.26, 0.26, 0.12), (0, 0, 0)), box_at((0.10, 0.02, 0.02), (0, -0.165, 0))]


def write_drawer(folder: Path, joint: str = "", mesh: str = "meshes/tray.obj") -> Path:
    """A cabinet of four boards with a drawer that slides out along -y by 0 to 0.2 m; with ``joint`` added."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    trimesh.util.concatenate(drawer_shells()).export(folder / "meshes" / "tray.obj")
    boards = "".join(
        f'<visual><origin xyz="{x} 0 {z}"/><geometry><box size="{a} 0.3 {c}"/></geometry></visual>'
        for x, z, a, c in (
            (-0.145, 0, 0.01, 0.2),
            (0.145, 0, 0.01, 0.2),
            (0, 0.095, 0.28, 0.01),
            (0, -0.095, 0.28, 0.01),
        )
    )
    (folder / "drawer.urdf").write_text(
        f"""<?xml version="1.0"?>
<robot name="drawer">
  <link name="cabinet">{boards}</link>
  <link name="tray"><visual><origin rpy="0 0 1.570796326794897"/><geometry><mesh filename="{mesh}"/></geometry></visual>
  </link>
  <joint name="slide" type="prismatic">
    <origin xyz="0 0 0.01" rpy="0 0 -1.5707963267948966"/><parent link="cabinet"/><child link="tray"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/>
  </joint>{joint}
</robot>"""
    )
    return folder / "drawer.urdf"


def write_laptop(folder: Path) -> Path:
    """A laptop of boxes, closed at zero, whose lid opens about -x by 0 to 2 rad; the screen is fixed to the lid."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y, z = LAPTOP_AXIS_M
    (folder / "laptop.urdf").write_text(
        f"""<robot name="laptop">
  <link name="base"><visual><origin xyz="0 0 0.009"/><geometry><box size="0.3 0.2 0.018"/></geometry></visual></link>
  <link name="lid"><visual><origin xyz="0 -0.1 0.006"/><geometry><box size="0.3 0.2 0.01"/></geometry></visual></link>
  <link name="screen"><collision><origin xyz="0 -0.1 0"/><geometry><box size="0.26 0.16 0.001"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute"><origin xyz="{x} {y} {z}"/><parent link="base"/><child link="lid"/>
    <axis xyz="-1 0 0"/><limit lower="0" upper="2" effort="1" velocity="1"/></joint>
  <joint name="glue" type="fixed"><parent link="lid"/><child link="screen"/></joint>
</robot>"""
    )
    return folder / "laptop.urdf"


def write_partnet(folder: Path) -> Path:
    """A cabinet with a door and a drawer as in PartNet-Mobility: y up, a fixed base joint, several meshes."""
    objs = folder / "textured_objs"
    objs.mkdir(parents=True, exist_ok=True)
    shells = {
        "body-1": box_at((0.4, 0.02, 0.3), (0, 0.24, 0)),
        "body-2": box_at((0.4, 0.02, 0.3), (0, -0.24, 0)),
        "body-3": box_at((0.4, 0.46, 0.02), (0, 0, -0.14)),
        "door": box_at((0.38, 0.20, 0.02), (0.19, 0, 0)),
        "knob": box_at((0.02, 0.02, 0.03), (0.35, 0, 0.03)),
        "tray": box_at((0.36, 0.18, 0.26), (0, 0, 0)),
        "grip": box_at((0.1, 0.02, 0.03), (0, 0, 0.15)),
    }
    for name, shell in shells.items():
        shell.export(objs / f"{name}.obj")

    def visuals(*names: str) -> str:
        return "".join(
            f'<visual name="{name}"><geometry><mesh filename="textured_objs/{name}.obj"/></geometry></visual>'
            for name in names
        )

    (folder / "mobility.urdf").write_text(
        f"""<?xml version="1.0" ?>
<robot name="partnet_1234">
  <link name="base"/>
  <link name="link_2">{visuals("body-1", "body-2", "body-3")}</link>
  <link name="link_0">{visuals("door", "knob")}</link>
  <link name="link_1">{visuals("tray", "grip")}</link>
  <joint name="joint_2" type="fixed"><origin rpy="1.570796326794897 0 -1.570796326794897" xyz="0 0 0"/>
    <child link="link_2"/><parent link="base"/></joint>
  <joint name="joint_0" type="revolute"><origin xyz="-0.19 0.12 0.14"/><axis xyz="0 -1 0"/><child link="link_0"/>
    <parent link="link_2"/><limit lower="0" upper="1.57"/></joint>
  <joint name="joint_1" type="prismatic"><origin xyz="0 -0.12 0"/><axis xyz="0 0 1"/><child link="link_1"/>
    <parent link="link_2"/><limit lower="0" upper="0.2"/></joint>
</robot>"""
    )
    return folder
