"""Chooses the grasps of a pair of verb and object: searched with an average hand, then closed for each subject."""

import numpy as np

from hoidata.errors import HoidataError
from hoidata.hands import HandPair
from hoidata.physics.contact_forces import body_motion
from hoidata.synthetic.closing import Placement
from hoidata.synthetic.grasps import (
    SMALLEST_HAND_GAP_M,
    Candidates,
    GraspSpec,
    Grip,
    Scene,
    capsule_contacts,
    clear_of_table,
    close_candidates,
    closes_force,
    hand_gap_m,
    posed_hands,
    sample_candidates,
    to_grip,
    verify,
)
from hoidata.synthetic.hand_capsules import CapsuleHands, capsule_hands

GRASPS_PER_PAIR = 2
_MAX_GRASPS = 8  # per subject
_RESERVES = 2
_CANDIDATES_PER_ROUND = 96
_MAX_ROUNDS = 40
_STRICT_ROUNDS = 4  # after these rounds, grasps need not work for all subjects
_VERIFIED_PER_ROUND = 6


def search_pool(
    scene: Scene,
    grasp: GraspSpec,
    pair: HandPair,
    betas: np.ndarray,
    rng: np.random.Generator,
    enough: int = GRASPS_PER_PAIR,
    rounds: int = _MAX_ROUNDS,
    complete: bool = True,
) -> list[list[tuple[Grip, ...]]]:
    """Search grasps for several subjects.

    Args:
        scene: the object.
        grasp: hands and directions.
        pair: hand models.
        betas: (subject, 10) hand shapes.
        rng: random numbers.
        enough: number of grasps that all subjects can use, at which the search ends.
        rounds: maximum number of rounds.
        complete: whether each subject needs a grasp.

    Returns:
        By subject, the grasps, each with one grip per hand.

    Raises:
        HoidataError: a subject has no grasp, with ``complete``.
    """
    average = capsule_hands(pair.right, np.zeros((1, 10)))
    subject_hands = capsule_hands(pair.right, betas)
    grasps_of: list[list[tuple[Grip, ...]]] = [[] for _ in betas]
    ranked: list[tuple[np.ndarray, list[tuple[Grip, ...] | None]]] = []
    for round_number in range(rounds):
        placements = _promising(scene, grasp, average, rng)
        if placements is None:
            continue
        ranked += _for_subjects(scene, grasp, placements, subject_hands, betas, pair)
        if _enough(np.array([scores > 0 for scores, _ in ranked]), round_number, enough):
            break
    ranked.sort(key=lambda entry: (-(entry[0] > 0).sum(), -entry[0].mean()))
    for _, grips in ranked:
        for subject, grip in enumerate(grips):
            if grip is not None and len(grasps_of[subject]) < _MAX_GRASPS:
                grasps_of[subject].append(grip)
    missing = [index for index, grips in enumerate(grasps_of) if not grips]
    if missing and complete:
        raise HoidataError(f"{scene.spec.name}: no {grasp.hand} grasp found for subjects {missing} of {len(grasps_of)}")
    return grasps_of


def _enough(works: np.ndarray, round_number: int, enough: int) -> bool:
    """Whether to stop: enough grasps for all subjects, later enough for each. works: (placement, subject) bool."""
    shared = int(works.all(axis=1).sum())
    return shared >= enough or (
        round_number >= _STRICT_ROUNDS and int(works.sum(axis=0).min()) >= max(enough, _RESERVES)
    )


def _promising(scene: Scene, grasp: GraspSpec, hands: CapsuleHands, rng: np.random.Generator) -> list[Placement] | None:
    """Sample placements, one per hand, whose capsule hands have force closure."""
    sides = []
    for side, reach in grasp.approaches:
        placement = sample_candidates(scene, side, reach, 3 * _CANDIDATES_PER_ROUND, rng)
        placement = placement.take(np.arange(min(_CANDIDATES_PER_ROUND, len(placement.hand))))
        closed = close_candidates(scene, side, placement, hands)
        sides.append(closed.take(np.flatnonzero(clear_of_table(scene, closed))))
    count = min(len(side.placement.hand) for side in sides)
    if count == 0:
        return None
    sides = [side.take(np.arange(count)) for side in sides]
    good = np.flatnonzero(_has_force_closure(scene, sides))[:_VERIFIED_PER_ROUND]
    return [side.placement.take(good) for side in sides] if len(good) else None


def _has_force_closure(scene: Scene, sides: list[Candidates]) -> np.ndarray:
    hinge = np.full(1, scene.hinge_rad) if scene.model.is_articulated else None
    centre = scene.upright @ body_motion(scene.model, np.eye(3)[None], np.zeros((1, 3)), hinge).centre_m[0]
    contacts = [capsule_contacts(scene, side) for side in sides]
    apart = hand_gap_m(sides) > SMALLEST_HAND_GAP_M
    is_closed = np.zeros(len(apart), dtype=bool)
    for index in np.flatnonzero(apart):
        points = np.concatenate([side[index][0] for side in contacts])
        normals = np.concatenate([side[index][1] for side in contacts])
        is_closed[index] = closes_force(points, normals, centre)
    return is_closed


def _for_subjects(
    scene: Scene, grasp: GraspSpec, placements, subject_hands: CapsuleHands, betas: np.ndarray, pair: HandPair
):
    """Return (subject,) scores and grips of each placement, closed with the hand of each subject."""
    n_subjects = len(betas)
    sides = [
        close_candidates(scene, side, placement.for_hands(n_subjects), subject_hands)
        for (side, _), placement in zip(grasp.approaches, placements, strict=True)
    ]
    posed = [posed_hands(side, betas) for side in sides]
    score = verify(scene, grasp, posed, pair)
    clear = np.all([clear_of_table(scene, side) for side in sides], axis=0) & (hand_gap_m(sides) > SMALLEST_HAND_GAP_M)
    score = np.where(clear, score, 0.0).reshape(-1, n_subjects)
    entries = []
    for index, scores in enumerate(score):
        grips = [
            tuple(
                to_grip(scene, reach, hand, index * n_subjects + subject)
                for (_, reach), hand in zip(grasp.approaches, posed, strict=True)
            )
            if scores[subject] > 0
            else None
            for subject in range(n_subjects)
        ]
        entries.append((scores, grips))
    return entries
