"""Joints, contact and words of a clip, from an annotated dataset: python examples/read_a_clip.py data/embedded/grab"""

import sys

from hoidata.store.annotated import load_annotated

store = load_annotated(sys.argv[1])
clip = store.clip(store.ids("test")[0])
print(store.sentences(clip.clip_id)[0])
print(f"{clip.n_frames} frames of {clip.object_words}; hand type {store.hand_type(clip.clip_id)}")
for side, hand in clip.hands.items():
    joints = store.joints(clip.clip_id, side)  # (frame, 21, 3) metres, world frame
    touched = int(store.contact_of(clip.clip_id, side).sum())
    print(
        f"{side}: valid in {hand.valid.sum()} frames, wrist begins at {joints[0, 0].round(3)}, {touched} points touched"
    )
