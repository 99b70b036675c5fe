"""Generated clips in the frame of a user's mesh."""

from dataclasses import replace

import numpy as np

from hoidata.hands import load_embedded_hands, track_joints
from hoidata.object_paths.mesh_frame import closed_as_stored, within_limits
from tests.builders.clips import DOWN, clip_of, flat_hand, still_object
from tests.builders.objects import box_model, hinged_box


def test_a_lid_starts_as_stored_and_its_hand_moves_with_it() -> None:
    pair, model, frames = load_embedded_hands(), hinged_box(), 12
    hinge_rad = np.linspace(0.5, 1.1, frames).astype(np.float32)
    track = replace(still_object(model, frames), hinge_rad=hinge_rad)
    lid_m = track.points_in_world(model.vertices_m, model.part)[:, model.part == 1].mean(axis=1)
    base_m = np.tile(model.vertices_m[model.part == 0].mean(axis=0) - [0, 0, 0.03], (frames, 1))
    clip = clip_of("generated/box", track, {"left": flat_hand(base_m), "right": flat_hand(lid_m)}, gravity=DOWN)
    closed = closed_as_stored(clip, pair)
    assert closed.object.hinge_rad is not None
    np.testing.assert_allclose(closed.object.hinge_rad, hinge_rad - 0.5, atol=1e-6)
    np.testing.assert_array_equal(closed.hands["left"].wrist_m, clip.hands["left"].wrist_m)
    in_lid_m = [
        model.object_from_part(1, one.object.hinge_rad).inverse()
        @ (one.object.world_from_object.inverse() @ track_joints(one.hands["right"], pair.right).astype(np.float64))
        for one in (clip, closed)
    ]
    np.testing.assert_allclose(in_lid_m[0], in_lid_m[1], atol=1e-5)
    assert closed_as_stored(replace(clip, object=still_object(box_model(), frames)), pair).hands == clip.hands


def test_at_a_limit_the_lid_stops_with_its_hand() -> None:
    pair, model, frames = load_embedded_hands(), hinged_box(), 12
    track = replace(still_object(model, frames), hinge_rad=np.linspace(0, 1.1, frames).astype(np.float32))
    lid_m = track.points_in_world(model.vertices_m, model.part)[:, model.part == 1].mean(axis=1)
    clip = clip_of("generated/box", track, {"right": flat_hand(lid_m)}, gravity=DOWN)
    assert within_limits(clip, (0.0, 1.2), pair) is clip
    assert within_limits(clip, None, pair) is clip
    cut = within_limits(clip, (0.0, 0.45), pair)
    np.testing.assert_allclose(cut.object.hinge_rad, np.minimum(track.hinge_rad, 0.45), atol=1e-6)
    np.testing.assert_allclose(cut.hands["right"].wrist_m[:5], clip.hands["right"].wrist_m[:5], atol=1e-6)
    lid_m = cut.object.points_in_world(model.vertices_m, model.part)[:, model.part == 1].mean(axis=1)
    np.testing.assert_allclose(np.ptp(cut.hands["right"].wrist_m[5:], axis=0), np.ptp(lid_m[5:], axis=0), atol=1e-5)
