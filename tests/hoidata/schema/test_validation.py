from dataclasses import replace

import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.schema.validation import check_clip


def with_hand(clip, **changes):
    return replace(clip, hands={**clip.hands, "right": replace(clip.hands["right"], **changes)})


def with_object(clip, **changes):
    return replace(clip, object=replace(clip.object, **changes))


def with_mesh(clip, scale):
    model = clip.object.model
    return with_object(clip, model=replace(model, vertices_m=model.vertices_m * scale))


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
    "no left hand": (lambda c: replace(c, hands={"right": c.hands["right"]}), "hands"),
    "a long gravity": (lambda c: replace(c, gravity=np.array([0, 0, -9.81])), "gravity"),
}


def test_a_sound_clip_passes_and_comes_back(make_clip):
    clip = make_clip(articulated=True)
    assert check_clip(clip) is clip


@pytest.mark.parametrize("name", BROKEN)
def test_a_clip_that_breaks_a_rule_is_named_with_its_field(make_clip, name):
    break_it, field = BROKEN[name]
    with pytest.raises(BadInput) as caught:
        check_clip(break_it(make_clip()))
    assert caught.value.where.startswith("test/s1/box_lift_1: ")
    assert field in caught.value.where
