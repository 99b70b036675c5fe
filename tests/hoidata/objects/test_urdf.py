"""Objects of URDF files: parts, joints and limits; files that must not be trusted."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.objects.urdf import find_urdf
from hoidata.objects.user_mesh import is_object_path, read_user_object
from tests.builders.urdf import DRAWER_M, LAPTOP_AXIS_M, drawer_shells, write_drawer, write_laptop, write_partnet

JOINT = """<link name="door"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>
<joint name="door_hinge" type="revolute"><parent link="cabinet"/><child link="door"/><axis xyz="0 0 1"/></joint>"""


def test_a_drawer_slides_along_the_axis_in_the_root_frame_with_all_its_shells(tmp_path: Path) -> None:
    user = read_user_object(write_drawer(tmp_path))
    model = user.model
    assert model.hinge is not None
    assert model.hinge.is_prismatic
    assert user.joint_limits == (0.0, 0.2)
    np.testing.assert_allclose(model.hinge.axis, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(np.ptp(model.vertices_m[model.part == 0], axis=0), DRAWER_M, atol=1e-9)
    shells = np.concatenate([shell.vertices for shell in drawer_shells()])
    # The joint's frame is turned by -90 degrees about z, and the mesh back; both are 1 cm above the root.
    np.testing.assert_allclose(model.vertices_m[model.part == 1], shells + np.array([0, 0, 0.01]), atol=1e-6)
    moved = model.object_from_part(1, np.array([0.0, 0.15])) @ model.vertices_m[None]
    np.testing.assert_allclose(moved[1] - moved[0], np.broadcast_to([0, -0.15, 0], moved[0].shape), atol=1e-12)


def test_the_lid_of_a_laptop_turns_about_its_joint_and_takes_the_fixed_screen_along(tmp_path: Path) -> None:
    user = read_user_object(write_laptop(tmp_path))
    model = user.model
    assert user.joint_limits == (0.0, 2.0)
    assert (model.part == 1).sum() == 16
    assert any("collision meshes count: screen" in note for note in user.notes)
    turned = model.object_from_part(1, np.array([1.2])) @ model.vertices_m[None]
    expected = Rotation.from_rotvec([-1.2, 0, 0]).apply(model.vertices_m - LAPTOP_AXIS_M) + LAPTOP_AXIS_M
    np.testing.assert_allclose(turned[0], expected, atol=1e-9)
    # The front edge of the lid rises.
    front = model.vertices_m[model.part == 1][:, 1].argmin()
    assert (turned[0] - model.vertices_m)[model.part == 1][front, 2] > 0.1


def test_a_partnet_folder_needs_the_name_of_one_of_its_joints(tmp_path: Path) -> None:
    folder = write_partnet(tmp_path / "1234")
    with pytest.raises(BadInput, match=r"joint_0 \(revolute\), joint_1 \(prismatic\).*--moving NAME"):
        read_user_object(folder)
    with pytest.raises(BadInput, match=r"'joint_9'; there are: joint_0"):
        read_user_object(folder, moving="joint_9")
    door, drawer = (read_user_object(folder, moving=name) for name in ("joint_0", "joint_1"))
    assert [user.model.name for user in (door, drawer)] == ["1234", "1234"]
    assert [user.model.hinge.is_prismatic for user in (door, drawer)] == [False, True]
    assert (door.model.part == 1).sum() == (drawer.model.part == 1).sum() == 16
    # The base joint turns y up to z up: the door's axis is vertical, the drawer opens to the front, -x.
    np.testing.assert_allclose(door.model.hinge.axis, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(drawer.model.hinge.axis, [-1, 0, 0], atol=1e-9)
    assert any("at rest: joint_1" in note for note in door.notes)
    np.testing.assert_allclose(np.ptp(door.model.vertices_m, axis=0)[2], 0.5, atol=1e-9)


def test_other_axes_and_units_move_joint_and_limits_along(tmp_path: Path) -> None:
    metres, inches = (read_user_object(write_drawer(tmp_path), unit=unit, up="y") for unit in ("m", "inch"))
    np.testing.assert_allclose(metres.model.hinge.axis, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(inches.model.vertices_m, 0.0254 * metres.model.vertices_m)
    assert inches.joint_limits == pytest.approx((0, 0.2 * 0.0254))


def test_a_joint_rests_within_its_limits(tmp_path: Path) -> None:
    path = write_drawer(tmp_path)
    path.write_text(path.read_text().replace('lower="0" upper="0.2"', 'lower="0.05" upper="0.2"'))
    user = read_user_object(path)
    assert user.joint_limits == pytest.approx((0, 0.15))
    assert user.model.hinge.file_position == 0.05
    assert user.model.scaled(2).hinge.file_position == 0.1
    assert read_user_object(path, unit="inch").model.hinge.file_position == pytest.approx(0.05 * 0.0254)
    at_zero = read_user_object(write_drawer(tmp_path / "zero")).model
    moving = at_zero.part == 1
    shift = user.model.vertices_m[moving] - at_zero.vertices_m[moving]
    np.testing.assert_allclose(shift, np.broadcast_to([0, -0.05, 0], shift.shape), atol=1e-9)


def test_a_package_path_is_the_folder_or_its_subfolder(tmp_path: Path) -> None:
    for name in ("package://meshes/tray.obj", "package://drawer/meshes/tray.obj"):
        path = write_drawer(tmp_path, mesh=name)
        assert (read_user_object(path).model.part == 1).sum() == 16
    ros = tmp_path / "ros"
    write_drawer(ros / "urdf", mesh="../meshes/tray.obj")
    (ros / "urdf" / "meshes").rename(ros / "meshes")
    with pytest.raises(BadInput, match="give the folder that contains both"):
        read_user_object(ros / "urdf" / "drawer.urdf")
    assert (read_user_object(ros).model.part == 1).sum() == 16


@pytest.mark.parametrize(
    "name", ["../secret.obj", "{root}/secret.obj", "file://{root}/secret.obj", "package://../secret.obj", "inside.obj"]
)
def test_a_mesh_outside_of_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    drawer_shells()[0].export(tmp_path / "secret.obj")
    path = write_drawer(tmp_path / "drawer", mesh=name.format(root=tmp_path))
    (tmp_path / "drawer" / "inside.obj").symlink_to(tmp_path / "secret.obj")
    with pytest.raises(BadInput, match="one outside of it"):
        read_user_object(path)


ENTITIES = '<!DOCTYPE r [<!ENTITY a "x"><!ENTITY b "&a;&a;">]>'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<robot", f"{ENTITIES}<robot"), "XML without a document type"),
        (("<robot", '<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot'), "XML without a document type"),
        (("</robot>", ""), "a URDF file, XML in UTF-8"),
        (("robot", "sdf"), "root element is robot, got sdf"),
        (("prismatic", "floating"), "a joint of type revolute"),
        (('child link="tray"', 'child link="nothing"'), "two links of the file, got 'nothing'"),
        (('parent link="cabinet"', 'parent link="tray"'), "joints from the root link to all others, got a loop"),
        (('axis xyz="1 0 0"', 'axis xyz="0 0 0"'), "an axis with a direction"),
        (('axis xyz="1 0 0"', 'axis xyz="1 nan 0"'), "3 finite numbers, got 1 nan 0"),
        (('lower="0"', 'lower="0.3"'), "a lower limit below the upper one"),
        (('upper="0.2"', 'upper="90"'), "they look like another unit: write that of the meshes"),
        (('lower="0"', 'lower="-1e30"'), 'if the joint has no stop, remove the element "limit"'),
        (('size="0.01', 'size="${w} 0.01'), "macros of xacro; expand it with xacro first"),
        (("<box size", "<capsule size"), "a mesh, box, cylinder or sphere, got capsule"),
        (('size="0.01', 'size="-0.01'), "above 0"),
        (("tray.obj", "none.obj"), "no such file"),
        (("tray.obj", "tray.dae"), "no such file"),
        (('filename="meshes/tray.obj"', 'filename="meshes/tray.obj" scale="1 0 1"'), "factors other than 0"),
        (('name="tray"', 'name="cabinet"'), "each link once"),
    ],
)
def test_an_unusable_file_is_refused_with_its_fault(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    path = write_drawer(tmp_path)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(BadInput, match=message):
        read_user_object(path)


def test_entities_in_another_encoding_are_refused(tmp_path: Path) -> None:
    path = write_drawer(tmp_path)
    path.write_bytes(path.read_text().replace("<robot", f"{ENTITIES}<robot").encode("utf-16"))
    with pytest.raises(BadInput, match="XML in UTF-8"):
        read_user_object(path)


def test_a_deeply_nested_file_and_a_mesh_repeated_often_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.urdf"
    path.write_text("<robot>" + "<a>" * 300_000 + "</a>" * 300_000 + "</robot>")
    with pytest.raises(BadInput):
        read_user_object(path)
    path = write_drawer(tmp_path / "often")
    shape = '<visual><geometry><mesh filename="meshes/tray.obj"/></geometry></visual>'
    path.write_text(path.read_text().replace('<link name="tray">', f'<link name="tray">{shape * 3000}'))
    with pytest.raises(BadInput, match="at most 3000000 triangles in 2000 meshes"):
        read_user_object(path)


def test_a_mirrored_mesh_keeps_its_volume_positive(tmp_path: Path) -> None:
    path = write_drawer(tmp_path)
    path.write_text(path.read_text().replace('tray.obj"', 'tray.obj" scale="-1 1 1"'))
    assert read_user_object(path).model.masses[1].source == "solid"


def test_a_second_joint_of_a_drawer_must_be_chosen_and_hinge_is_refused(tmp_path: Path) -> None:
    path = write_drawer(tmp_path, joint=JOINT)
    with pytest.raises(BadInput, match=r"slide \(prismatic\), door_hinge \(revolute\)"):
        read_user_object(path)
    assert not read_user_object(path, moving="door_hinge").model.hinge.is_prismatic
    with pytest.raises(BadInput, match="no hinge with a URDF"):
        read_user_object(path, hinge="0,0,0 1,0,0")


def test_a_folder_counts_as_an_object_only_with_a_urdf(tmp_path: Path) -> None:
    (tmp_path / "mug").mkdir()
    assert not is_object_path(str(tmp_path / "mug"))
    assert is_object_path(str(write_partnet(tmp_path / "cabinet")))
    write_drawer(tmp_path / "two")
    (tmp_path / "two" / "other.urdf").write_text("<robot/>")
    with pytest.raises(BadInput, match=r"drawer\.urdf, other\.urdf"):
        find_urdf(tmp_path / "two")


@pytest.mark.parametrize(
    ("upper", "remedy"),
    [
        (
            "120",
            "they look like degrees: write radians, 0 and 2.094; if the joint has no stop, make its type continuous",
        ),
        ("1e30", "got 0 and 1e\\+30; if the joint has no stop, make its type continuous"),
    ],
)
def test_limits_of_a_hinge_beyond_two_turns_are_refused(upper: str, remedy: str, tmp_path: Path) -> None:
    path = write_laptop(tmp_path)
    for limit in ("12.5", upper):
        path.write_text(re.sub('upper="[^"]*"', f'upper="{limit}"', path.read_text()))
        if limit == "12.5":
            assert read_user_object(path).joint_limits == (0.0, 12.5)
    with pytest.raises(BadInput, match=f"limits of at most 4 pi rad, two turns, .*{remedy}"):
        read_user_object(path)


def test_a_joint_whose_link_has_no_mesh_is_named(tmp_path: Path) -> None:
    path = write_drawer(tmp_path)
    link = path.read_text().partition('<link name="tray">')[2].partition("</link>")[0]
    path.write_text(path.read_text().replace(link, ""))
    with pytest.raises(BadInput, match=r"joint 'slide': expected a mesh in its link 'tray', got none; add .* or make"):
        read_user_object(path)
    with pytest.raises(BadInput, match=r"'slide'; there are: slide \(its link tray has no mesh\)"):
        read_user_object(path, moving="slide")
    path.write_text(path.read_text().replace("prismatic", "fixed"))
    assert not read_user_object(path).model.is_articulated
    assert "the URDF has no movable joint: the object is rigid" in read_user_object(path).notes


def test_a_suffix_in_capitals_is_found_and_a_xacro_file_must_be_expanded(tmp_path: Path) -> None:
    path = write_drawer(tmp_path / "drawer")
    path.rename(path.with_name("R.URDF"))
    assert is_object_path(str(tmp_path / "drawer"))
    assert read_user_object(tmp_path / "drawer").model.is_articulated
    xacro = path.with_name("drawer.urdf.xacro")
    path.with_name("R.URDF").rename(xacro)
    for name in (xacro, tmp_path / "drawer"):
        with pytest.raises(BadInput, match=r"drawer\.urdf\.xacro: .*expand it with xacro first: xacro FILE"):
            read_user_object(name)
