from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips import BodyTrack, CameraTrack, SourceContact
from hoidata.clips.validation import check_clip
from hoidata.errors import BadInput
from tests.builders.clips import with_hand, with_object


def with_mesh(clip, scale):
    model = clip.object.model
    return with_object(clip, model=replace(model, vertices_m=model.vertices_m * scale))


def with_camera(clip, **changes):
    numbers = np.zeros((30, 3), np.float32)
    camera = CameraTrack(
        name="cam4", rotvec=numbers, position_m=numbers, images=np.arange(30, dtype=np.int32), intrinsics=np.ones(6)
    )
    return replace(clip, camera=replace(camera, **changes))


def with_body(clip, **changes):
    arrays = [np.zeros((30, columns), np.float32) for columns in (3, 3, 63, 9, 10)]
    return replace(clip, body=replace(BodyTrack(*arrays), **changes))


def with_contact(clip, frame, vertex, label=(21, 22)):
    arrays = np.array(frame, np.int32), np.array(vertex, np.int32), np.array(label, np.int64)
    return replace(clip, source_contact=SourceContact(*arrays))


BROKEN = {
    "a wrist in millimetres": (lambda c: with_hand(c, wrist_m=c.hands["right"].wrist_m * 1000), "wrist_m"),
    "a frame too few": (lambda c: with_hand(c, hand_pose=c.hands["right"].hand_pose[1:]), "hand_pose"),
    "44 angles": (lambda c: with_hand(c, hand_pose=c.hands["right"].hand_pose[:, 1:]), "hand_pose"),
    "NaN": (lambda c: with_hand(c, global_orient=c.hands["right"].global_orient * np.nan), "global_orient"),
    "flags that are numbers": (lambda c: with_hand(c, valid=np.ones(30)), "valid"),
    "two rows of betas": (lambda c: with_hand(c, betas=np.zeros((2, 10))), "betas"),
    "a small template": (lambda c: with_hand(c, template_m=np.zeros((777, 3))), "template_m"),
    "a template in millimetres": (lambda c: with_hand(c, template_m=np.eye(778, 3) * 180), "template_m"),
    "a mesh in millimetres": (lambda c: with_mesh(c, 1000), "vertices_m"),
    "a mesh in kilometres": (lambda c: with_mesh(c, 0.001), "vertices_m"),
    "a hinge angle without a hinge": (lambda c: with_object(c, hinge_rad=np.zeros(30)), "hinge_rad"),
    "an object of whole numbers": (lambda c: with_object(c, rotvec=np.zeros((30, 3), int)), "rotvec"),
    "frames that go back": (lambda c: replace(c, source_frames=c.source_frames[::-1]), "source_frames"),
    "a frame twice": (lambda c: replace(c, source_frames=np.r_[0, 0:29].astype(np.int32)), "source_frames"),
    "no left hand": (lambda c: replace(c, hands={"right": c.hands["right"]}), "hands"),
    "a long gravity": (lambda c: replace(c, gravity=np.array([0, 0, -9.81])), "gravity"),
    "a flat gravity": (lambda c: replace(c, gravity=np.array([0.0, -1.0])), "gravity"),
    "no gravity and no reason": (lambda c: replace(c, gravity=None), "gravity_note"),
    "a flat transform": (lambda c: replace(c, source_from_world=np.diag([1.0, 1, 0, 1])), "source_from_world"),
    "a perspective": (lambda c: replace(c, source_from_world=np.diag([1.0, 1, 1, 2])), "source_from_world"),
    "a transform of 9 numbers": (lambda c: replace(c, source_from_world=np.eye(3)), "source_from_world"),
    "hands from nowhere": (lambda c: replace(c, hands_from="guesses"), "hands_from"),
    "a fit without its error": (lambda c: replace(c, hands_from="keypoints"), "fit_error_m"),
    "an error without a fit": (lambda c: replace(c, fit_error_m=0.01), "fit_error_m"),
    "an error of NaN": (lambda c: replace(c, hands_from="keypoints", fit_error_m=float("nan")), "fit_error_m"),
    "no rate": (lambda c: replace(c, source_fps=0.0), "source_fps"),
    "a camera of fewer frames": (lambda c: with_camera(c, rotvec=np.zeros((29, 3))), "camera.rotvec"),
    "a camera in millimetres": (lambda c: with_camera(c, position_m=np.full((30, 3), 900.0)), "camera.position_m"),
    "images that are no numbers": (lambda c: with_camera(c, images=np.zeros(30)), "camera.images"),
    "a focal length of NaN": (lambda c: with_camera(c, intrinsics=np.full(6, np.nan)), "camera.intrinsics"),
    "a body with hands": (lambda c: with_body(c, body_pose=np.zeros((30, 153))), "body.body_pose"),
    "50 expressions": (lambda c: with_body(c, expression=np.zeros((30, 50))), "body.expression"),
    "a body in millimetres": (lambda c: with_body(c, transl_m=np.full((30, 3), 900.0)), "body.transl_m"),
    "a contact after the end": (lambda c: with_contact(c, (3, 30), (1, 2)), "source_contact.frame"),
    "a contact with no vertex": (lambda c: with_contact(c, (3, 4), (1, 8)), "source_contact.vertex"),
    "a label too large": (lambda c: with_contact(c, (3, 4), (1, 2), (21, 256)), "source_contact.label"),
    "contacts of unequal lengths": (lambda c: with_contact(c, (3, 4), (1,)), "source_contact.vertex"),
    "contacts out of order": (lambda c: with_contact(c, (3, 3), (2, 1)), "source_contact"),
    "a contact twice": (lambda c: with_contact(c, (3, 3), (2, 2)), "source_contact"),
}


def test_a_sound_clip_passes_and_comes_back(make_clip):
    clip = with_contact(with_body(with_camera(make_clip(articulated=True))), (3, 3), (1, 2))
    assert check_clip(clip) is clip
    bare = with_camera(
        with_body(replace(clip, gravity=None, gravity_note="not said"), expression=None), intrinsics=None
    )
    assert check_clip(bare) is bare


def test_where_a_hand_that_is_not_there_lies_does_not_matter(make_clip):
    clip, valid = make_clip(), np.arange(30) != 7
    wrist = np.where(valid[:, None], clip.hands["right"].wrist_m, np.float32(1e6))
    check_clip(with_hand(clip, wrist_m=wrist, valid=valid))
    with pytest.raises(BadInput, match="wrist_m"):
        check_clip(with_hand(clip, wrist_m=wrist))


@pytest.mark.parametrize("name", BROKEN)
def test_a_clip_that_breaks_a_rule_is_named_with_its_field(make_clip, name):
    break_it, field = BROKEN[name]
    with pytest.raises(BadInput) as caught:
        check_clip(break_it(make_clip()))
    assert caught.value.where.startswith("test/s1/box_lift_1: ")
    assert field in caught.value.where
