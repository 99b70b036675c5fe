"""Controls of physical realism on scenes whose answer is known: free fall, a table, pinches, sliding hands."""

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel, articulate
from hoidata.physics.capsules import Capsules, ObjectPoses, capsule_contacts
from hoidata.physics.contact_forces import cone_edges
from hoidata.physics.realism import (
    AsReleased,
    StandardUnits,
    every_frame_passes,
    friction_edges,
    score,
    smoothness_m_s2,
    table_contacts,
)
from hoidata.physics.scene import Scene, clip_scene
from tests.builders.objects import box_model, two_parts

SIZE = np.array([0.1, 0.08, 0.06])
DOWN = np.array([0.0, 0.0, -1.0])
FPS = 120.0
NONE = np.zeros((20, 0, 3))


BOX = box_model(tuple(SIZE))


def _scene(centre_m: np.ndarray, rotmats: np.ndarray | None = None, hands: Capsules | None = None, **options) -> Scene:
    turned = np.tile(np.eye(3), (len(centre_m), 1, 1)) if rotmats is None else rotmats
    hands = Capsules(NONE, NONE, np.zeros(0)) if hands is None else hands
    return Scene(BOX, ObjectPoses(turned, centre_m), hands, fps=FPS, gravity=DOWN, **{"table_m": 0.0, **options})


def _times() -> np.ndarray:
    return np.arange(20)[:, None] / FPS


def _pinch(centre_m: np.ndarray, rotmats: np.ndarray | None = None, sides=(-1, 1)) -> Capsules:
    """Two fingers along y pressed 1 mm into the +x and -x faces, carried along with the object."""
    turned = np.tile(np.eye(3), (len(centre_m), 1, 1)) if rotmats is None else rotmats
    radius = 0.01
    middle = np.array([[side * (SIZE[0] / 2 + radius - 0.001), 0, z] for side in sides for z in (-0.01, 0.01)])
    half = np.array([0, 0.005, 0])
    ends = [(middle + end) @ turned.transpose(0, 2, 1) + centre_m[:, None] for end in (-half, half)]
    return Capsules(*ends, np.full(len(middle), radius))


def _thrown() -> tuple[np.ndarray, np.ndarray]:
    """A box thrown upwards, spinning about one of its principal axes: no torque is needed."""
    time = _times()
    centre = np.array([0.0, 0.0, 1.0]) + time * [0.3, 0.1, 1.0] - 0.5 * 9.81 * time**2 * [0, 0, 1]
    return centre, Rotation.from_rotvec(time * [0.0, 0.0, 4.0]).as_matrix()


def test_a_ballistic_flight_without_contact_is_explained_and_counts_as_lifted_but_not_held():
    scene = _scene(*_thrown())
    result = score(scene, StandardUnits())
    assert result.share == 1.0
    assert len(result.frames) == 20
    assert scene.lifted.all()
    assert not scene.held.any()


def test_an_object_held_in_the_air_without_any_contact_is_never_explained():
    time = _times()
    paths = {
        "still": np.tile([0.0, 0.0, 0.5], (20, 1)),
        "circling": 0.5 + 0.05 * np.concatenate([np.cos(6 * time), np.sin(6 * time), 0 * time], axis=1),
        "lifted": np.array([0, 0, 0.5]) + time * [0, 0, 0.4],
    }
    for path in paths.values():
        scene = _scene(path)
        assert scene.held.all()
        result = score(scene, StandardUnits(), scene.held)
        assert result.share == 0.0
        assert result.residual.min() > 5  # of 9.81 N


def test_a_pinch_carries_the_box_along_any_gentle_motion_and_one_side_alone_does_not():
    time = _times()
    centre = np.array([0.0, 0.0, 0.5]) + 0.05 * np.concatenate([np.sin(5 * time), 1 - np.cos(5 * time), 0 * time], 1)
    turned = Rotation.from_rotvec(time * [0.0, 0.0, 1.0]).as_matrix()
    assert score(_scene(centre, turned, _pinch(centre, turned)), StandardUnits()).share == 1.0
    assert score(_scene(centre, turned, _pinch(centre, turned, sides=(1,))), StandardUnits()).share == 0.0
    away = _pinch(centre, turned).moved(np.array([0.0, 0.0, 0.1]))
    assert score(_scene(centre, turned, away), StandardUnits()).share == 0.0


def test_residuals_do_not_depend_on_the_world_frame():
    centre = np.array([0.0, 0.0, 0.5]) + 0.3 * np.random.default_rng(0).normal(size=(20, 3)).cumsum(axis=0) / FPS**2
    hands = _pinch(centre, sides=(1,))
    rotation, shift = Rotation.from_rotvec([0.5, 1.0, -0.3]).as_matrix(), np.array([1.0, -2.0, 0.3])
    scene = _scene(centre, hands=hands)
    moved = Scene(
        BOX,
        ObjectPoses(np.tile(rotation, (20, 1, 1)), centre @ rotation.T + shift),
        Capsules(hands.start_m @ rotation.T + shift, hands.end_m @ rotation.T + shift, hands.radius_m),
        fps=FPS,
        gravity=rotation @ DOWN,
        table_m=float(-(rotation @ DOWN) @ shift),
    )
    for variant_scene in (scene, moved):
        assert variant_scene.held.all()
    first, second = (score(variant_scene, StandardUnits()) for variant_scene in (scene, moved))
    assert first.residual.max() > 1
    # The four edges of a cone turn about its normal with the world, so only a little of a residual may change.
    np.testing.assert_allclose(first.residual, second.residual, rtol=0.1)


def test_frames_with_a_capsule_too_deep_are_not_scored():
    centre = np.tile([0.0, 0.0, 0.5], (20, 1))
    hands = _pinch(centre)
    shift = np.zeros((20, 3))
    shift[5:8, 0] = 0.02  # one finger 21 mm into the box, the other off it
    result = score(_scene(centre, hands=hands.moved(shift)), StandardUnits())
    assert result.frames.tolist() == [*range(5), *range(8, 20)]
    np.testing.assert_allclose(result.penetration_m[5:8], 0.021, atol=1e-6)
    np.testing.assert_allclose(result.penetration_m[8:], 0.001, atol=1e-6)
    assert result.colliding_m == pytest.approx((17 * 4 * 0.001 + 3 * 2 * 0.021) / (17 * 4 + 3 * 2), abs=1e-6)


ALL = np.ones(20, bool)
ON_TABLE = np.tile([0.0, 0.0, SIZE[2] / 2], (20, 1))


def _pushed(acceleration_m_s2: float) -> np.ndarray:
    """A box that slides on the table along x."""
    return ON_TABLE + 0.5 * acceleration_m_s2 * _times() ** 2 * [1, 0, 0]


def test_the_table_carries_what_rests_on_it_and_nothing_that_is_lifted():
    assert every_frame_passes(_scene(ON_TABLE), ALL).all()
    lifted = ON_TABLE + np.array([0, 0, 0.016])
    assert not every_frame_passes(_scene(lifted), ALL).any()
    assert every_frame_passes(_scene(lifted, hands=_pinch(lifted)), ALL).all()


def test_the_table_pushes_only_up_and_within_its_friction_cone():
    assert every_frame_passes(_scene(_pushed(0.3 * 9.81)), ALL).all()  # friction .35
    fast = _pushed(0.6 * 9.81)
    assert not every_frame_passes(_scene(fast), ALL).any()
    assert every_frame_passes(_scene(fast, hands=_pinch(fast, sides=(-1,))), ALL).all()  # a finger pushes along +x
    assert not every_frame_passes(_scene(fast, hands=_pinch(fast, sides=(1,))), ALL).any()  # from the other side
    pulled_down = ON_TABLE - 0.5 * 15 * (_times() - _times().mean()) ** 2 * [0, 0, 1]
    assert not every_frame_passes(_scene(pulled_down, table_m=0.0), ALL).any()


def test_a_box_on_its_edge_needs_a_hand():
    on_edge = np.tile(rotvec_to_rotmat(np.array([0.0, 0.5, 0.0])), (20, 1, 1))
    corners = BOX.vertices_m @ on_edge[0].T
    centre = np.tile([0.0, 0.0, -corners[:, 2].min()], (20, 1))
    assert not every_frame_passes(_scene(centre, on_edge), ALL).any()
    assert every_frame_passes(_scene(centre, on_edge, _pinch(centre, on_edge)), ALL).all()


def test_a_frame_with_a_capsule_too_deep_does_not_pass():
    shift = np.zeros((20, 3))
    shift[5:8, 0] = 0.02  # one finger 21 mm into the box
    passed = every_frame_passes(_scene(ON_TABLE, hands=_pinch(ON_TABLE).moved(shift)), ALL)
    assert np.flatnonzero(~passed).tolist() == [5, 6, 7]


def test_only_the_chosen_frames_are_scored():
    path = ON_TABLE.copy()
    path[10:, 2] += 0.05
    chosen = np.arange(20) % 3 == 0
    passed = every_frame_passes(_scene(path), chosen)
    np.testing.assert_array_equal(passed, every_frame_passes(_scene(path), ALL)[chosen])
    assert passed.any()
    assert not passed.all()


def test_a_box_touches_the_table_with_the_corners_of_its_lower_face():
    contacts = table_contacts(_scene(ON_TABLE), np.array([2, 7]))
    assert contacts.frame.tolist() == [2] * 4 + [7] * 4
    corners = {(x, y, 0.0) for x in (-0.05, 0.05) for y in (-0.04, 0.04)}
    assert {tuple(np.round(point, 6) + 0.0) for point in contacts.point_m[:4]} == corners
    np.testing.assert_array_equal(contacts.normal, np.tile(DOWN, (8, 1)))


def _by_scipy(wrench: np.ndarray, edges: np.ndarray, arms: np.ndarray) -> float:
    columns = [[*edge, *np.cross(arm, edge)] for arm, four in zip(arms, edges, strict=True) for edge in four]
    return float(nnls(np.array(columns).T, wrench)[1])


def test_residuals_of_both_variants_are_those_of_a_system_set_up_by_hand():
    time = _times()
    path = np.array([0.0, 0, 0.5]) + 0.5 * 3.0 * time**2 * [-1, 0.5, 0]  # the finger pushes along -x
    turned = Rotation.from_rotvec(time**2 * [40.0, 90.0, 20.0]).as_matrix()
    scene = _scene(path, turned, _pinch(path, turned, sides=(1,)))
    contacts = capsule_contacts(scene.model, scene.poses, scene.capsules)
    frame, released = 7, AsReleased()
    in_frame = contacts.frame == frame
    assert in_frame.sum() == 2
    arms = contacts.point_m[in_frame] - path[frame]
    ours = StandardUnits().residuals(scene, contacts)[frame]
    assert ours == pytest.approx(_by_scipy(scene.wrench[frame], cone_edges(contacts.normal[in_frame]), arms), rel=1e-9)
    edges = friction_edges(contacts.normal[in_frame])
    wrench = released.wrench(scene)[frame]
    expected = _by_scipy(wrench, edges, arms * 10) ** 2 / 6
    assert expected < 0.9 * wrench @ wrench / 6  # the contacts do something
    assert released.residuals(scene, contacts)[frame] == pytest.approx(expected, rel=1e-9)


def test_the_released_torque_is_per_frame_in_square_decimetres_with_its_gyroscopic_part():
    time, step = _times(), 1 / FPS
    path = np.tile([0.0, 0, 0.5], (20, 1))
    x, y, z = (10 * SIZE) ** 2
    inertia = np.diag([y + z, x + z, x + y]) / 12
    # Faster and faster about z: the angle is t^2, the spin between frames 2 t + 1/FPS, its change 2/FPS.
    faster = _scene(path, Rotation.from_rotvec(time**2 * [0.0, 0, 1.0]).as_matrix())
    torque = AsReleased().wrench(faster)[:-2, 3:]
    np.testing.assert_allclose(torque, np.tile([0, 0, inertia[2, 2] * 2 * step], (18, 1)), atol=1e-9)
    # Steady about an oblique axis: only w x I w is left.
    spin = np.array([2.0, 1.0, -3.0])
    turned = Rotation.from_rotvec(time * spin).as_matrix()
    expected = [step * np.cross(spin, rotation @ inertia @ rotation.T @ spin) for rotation in turned]
    np.testing.assert_allclose(AsReleased().wrench(_scene(path, turned))[:, 3:], expected, atol=1e-9)


def test_as_released_passes_an_object_that_hangs_still_in_the_air_which_is_its_floor():
    scene = _scene(np.tile([0.0, 0.0, 0.5], (20, 1)))
    result = score(scene, AsReleased())
    assert result.share == 1.0
    # (9.8 / 120)^2 / 6, squared gravity per frame, is below the limit of 0.01.
    np.testing.assert_allclose(result.residual, (9.8 / 120) ** 2 / 6, rtol=1e-6)
    assert score(scene, StandardUnits()).share == 0.0


def test_as_released_measures_acceleration_in_decimetres_per_second_and_frame():
    time = _times()
    scene = _scene(np.array([0.0, 0, 0.5]) + 0.5 * 4.0 * time**2 * [1, 0, 0])
    expected = (4.0 * 10 / 120) ** 2 / 6 + (9.8 / 120) ** 2 / 6
    residual = score(scene, AsReleased()).residual
    np.testing.assert_allclose(residual[:-2], expected, rtol=1e-6)  # the last two have no frame after them


def test_as_released_does_not_depend_on_where_the_mesh_has_its_origin():
    time = _times()
    path = np.array([0.0, 0, 0.5]) + 0.5 * 3.0 * time**2 * [1, 0, 0]
    turned = Rotation.from_rotvec(time * [0.0, 2.0, 0.0]).as_matrix()
    shifted = ObjectModel("box", BOX.vertices_m + np.array([0, 0, 0.05]), BOX.faces, np.zeros(8, dtype=np.uint8))
    poses = ObjectPoses(turned, path - turned @ [0, 0, 0.05])
    scene = Scene(shifted, poses, Capsules(NONE, NONE, np.zeros(0)), fps=FPS, gravity=DOWN, table_m=0.0)
    expected = score(_scene(path, turned), AsReleased()).residual
    np.testing.assert_allclose(score(scene, AsReleased()).residual, expected, atol=1e-9)


def test_released_friction_edges_push_inwards_with_two_tangents_and_are_not_normalised():
    rng = np.random.default_rng(0)
    normals = np.concatenate([rng.normal(size=(50, 3)), [[0, 1.0, 0], [0, -1.0, 0], [1.0, 0, 0]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = friction_edges(normals)
    np.testing.assert_allclose(np.einsum("cek,ck->ce", edges, -normals), 1 / 0.35, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(edges, axis=2), np.hypot(1, 1 / 0.35), atol=1e-6)
    np.testing.assert_allclose(edges[:, 0] + edges[:, 1], edges[:, 2] + edges[:, 3], atol=1e-6)


def test_the_table_of_a_recording_is_the_third_percentile_of_the_lowest_vertex():
    heights = np.r_[np.full(15, 0.03), np.linspace(0.031, 0.2, 5)]
    scene = _scene(np.stack([0 * heights, 0 * heights, heights], axis=1), table_m=None)
    assert scene.table_height_m == pytest.approx(0.0, abs=1e-9)
    assert scene.lifted.tolist() == [bool(height - 0.03 > 0.015) for height in heights]


def test_a_lid_that_opens_counts_for_the_lowest_vertex():
    lid = box_model(tuple(SIZE), middle_m=(0, SIZE[1], 0))
    model = two_parts(BOX, lid, (1, 0, 0), (0, SIZE[1] / 2, -SIZE[2] / 2))
    poses = ObjectPoses(np.tile(np.eye(3), (3, 1, 1)), np.tile([0, 0, 0.5], (3, 1)), np.array([0.0, -0.5, -1.0]))
    scene = Scene(model, poses, Capsules(*np.zeros((2, 3, 0, 3)), np.zeros(0)), fps=FPS, gravity=DOWN)
    expected = 0.5 - SIZE[2] / 2 - SIZE[1] * np.sin([0, 0.5, 1.0])
    np.testing.assert_allclose(scene.lowest_m, expected, atol=1e-9)


def test_the_lowest_vertex_is_the_lowest_of_all_in_the_world():
    random = np.random.default_rng(0)
    model = two_parts(BOX, box_model(tuple(SIZE), middle_m=(0, SIZE[1], 0)), (0.6, 0, 0.8), (0, SIZE[1] / 2, 0))
    rotmats = Rotation.random(40, random_state=0).as_matrix()
    poses = ObjectPoses(rotmats, random.normal(size=(40, 3)), random.uniform(-2, 2, 40))
    gravity = np.array([0.36, 0.48, -0.8])
    scene = Scene(model, poses, Capsules(*np.zeros((2, 40, 0, 3)), np.zeros(0)), fps=FPS, gravity=gravity)
    local = articulate(model.vertices_m, model.part, model.hinge, poses.hinge_rad)
    expected = (poses.world_from_part(model, 0) @ local @ -gravity).min(axis=1)
    np.testing.assert_allclose(scene.lowest_m, expected, atol=1e-12)


def test_a_clip_becomes_a_scene_with_both_hands_and_an_invalid_hand_is_absent(make_clip):
    clip = make_clip(n_frames=6, hand_type="right")
    scene = clip_scene(clip, load_embedded_hands(), table_m=-1.0)
    assert scene.capsules.start_m.shape == (6, 38, 3)
    assert scene.fps == 30
    np.testing.assert_allclose(scene.poses.rotmats, rotvec_to_rotmat(clip.object.rotvec.astype(float)))
    clip.hands["right"].valid[2:4] = False
    absent = clip_scene(clip, load_embedded_hands(), table_m=-1.0)
    assert np.isnan(absent.capsules.start_m[2:4, 19:]).all()
    assert np.isfinite(absent.capsules.start_m[:, :19]).all()
    assert score(absent, StandardUnits()).frames.tolist() == [*range(6)]


def test_a_clip_without_gravity_is_refused(make_clip):
    with pytest.raises(BadInput, match="gravity"):
        clip_scene(make_clip(n_frames=6, gravity=None), load_embedded_hands())


def test_smoothness_is_the_acceleration_at_60_hz_in_the_frame_of_the_wrist():
    time = np.arange(241) / 120
    wave = 0.01 * np.sin(2 * np.pi * time)
    finger = np.stack([wave, 0 * wave, 0.1 + 0 * wave], axis=1)
    turned = Rotation.from_rotvec(time[:, None] * [1.0, 2.0, 0.5]).as_matrix()
    wrist = np.stack([time**3, -time, np.cos(5 * time)], axis=1)
    joints = np.stack([wrist, wrist + np.einsum("fij,fj->fi", turned, finger)], axis=1)
    # Mean of |sin| is 2/pi; the wrist itself counts with zero.
    expected = 0.5 * 0.01 * (2 * np.pi) ** 2 * 2 / np.pi
    assert smoothness_m_s2(joints, turned, 120.0) == pytest.approx(expected, rel=0.01)
    jitter = joints.copy()
    jitter[::4, 1] += 0.001
    assert smoothness_m_s2(jitter, turned, 120.0) > 10 * expected
    with pytest.raises(ValueError, match="three frames"):
        smoothness_m_s2(joints[:4], turned[:4], 120.0)


def test_smoothness_passes_over_frames_without_the_hand():
    time = np.arange(20) / 30
    joints = np.zeros((20, 2, 3))
    joints[:, 1, 0] = 0.1 + 0.5 * 4.0 * time**2
    joints[7:9] = np.nan
    turned = np.tile(np.eye(3), (20, 1, 1))
    assert smoothness_m_s2(joints, turned, 30.0) == pytest.approx(4.0 / 2)  # the wrist counts with zero
    joints[::3] = np.nan
    with pytest.raises(ValueError, match="three frames in a row"):
        smoothness_m_s2(joints, turned, 30.0)
