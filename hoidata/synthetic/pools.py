"""Choosing the few grasps a (verb, object) pair uses: searched with an average hand, closed again for every subject."""

import numpy as np

from hoidata.errors import HoidataError
from hoidata.hands import HandPair
from hoidata.physics.contact_forces import body_motion
from hoidata.synthetic.closing import Placement
from hoidata.synthetic.grasps import (
    SMALLEST_HAND_GAP_M,
    Candidates,
    Grip,
    Hold,
    Scene,
    capsule_contacts,
    clear_of_table,
    close_candidates,
    closes_force,
    draw_candidates,
    hand_gap_m,
    posed_hands,
    to_grip,
    verify,
)
from hoidata.synthetic.hand_capsules import CapsuleHands, capsule_hands

GRASPS_PER_PAIR = 2
_KEPT = 8
_RESERVES = 2
_ROUND = 96
_MOST_ROUNDS = 40
_ENOUGH_ROUNDS = 4
_TRIED_PER_ROUND = 6


def search_pool(
    scene: Scene,
    hold: Hold,
    pair: HandPair,
    betas: np.ndarray,
    rng: np.random.Generator,
    wanted: int = GRASPS_PER_PAIR,
    rounds: int = _MOST_ROUNDS,
    complete: bool = True,
) -> list[list[tuple[Grip, ...]]]:
    """Grasps of ``hold`` for subjects with ``betas (subject, 10)``. Raises HoidataError where a subject has none,
    unless the grasps need not be ``complete``.

    Per subject its choices, each with one grip per hand. wanted: placements that all subjects can use, after which the
    search ends; rounds: after so many it ends anyway.
    """
    average = capsule_hands(pair.right, np.zeros((1, 10)))
    own = capsule_hands(pair.right, betas)
    table: list[list[tuple[Grip, ...]]] = [[] for _ in betas]
    ranked: list[tuple[np.ndarray, list[tuple[Grip, ...] | None]]] = []
    for round_number in range(rounds):
        placements = _promising(scene, hold, average, rng)
        if placements is None:
            continue
        ranked += _for_subjects(scene, hold, placements, own, betas, pair)
        if _enough(np.array([scores > 0 for scores, _ in ranked]), round_number, wanted):
            break
    ranked.sort(key=lambda entry: (-(entry[0] > 0).sum(), -entry[0].mean()))
    for _, grips in ranked:
        for subject, grip in enumerate(grips):
            if grip is not None and len(table[subject]) < _KEPT:
                table[subject].append(grip)
    missing = [index for index, grips in enumerate(table) if not grips]
    if missing and complete:
        raise HoidataError(f"{scene.spec.name}: no {hold.hand} grasp found for subjects {missing} of {len(table)}")
    return table


def _enough(works: np.ndarray, round_number: int, wanted: int) -> bool:
    """works: (placement, subject) bool. Best is a placement that all subjects can use; later, any for each will do."""
    shared = int(works.all(axis=1).sum())
    return shared >= wanted or (
        round_number >= _ENOUGH_ROUNDS and int(works.sum(axis=0).min()) >= max(wanted, _RESERVES)
    )


def _promising(scene: Scene, hold: Hold, hands: CapsuleHands, rng: np.random.Generator) -> list[Placement] | None:
    """Placements (one per hand) whose capsule hands hold the object; rows of the hands belong together."""
    sides = []
    for side, reach in hold.reaches:
        placement = draw_candidates(scene, side, reach, 3 * _ROUND, rng)
        placement = placement.take(np.arange(min(_ROUND, len(placement.hand))))
        closed = close_candidates(scene, side, placement, hands)
        sides.append(closed.take(np.flatnonzero(clear_of_table(scene, closed))))
    count = min(len(side.placement.hand) for side in sides)
    if count == 0:
        return None
    sides = [side.take(np.arange(count)) for side in sides]
    good = np.flatnonzero(_holds(scene, sides))[:_TRIED_PER_ROUND]
    return [side.placement.take(good) for side in sides] if len(good) else None


def _holds(scene: Scene, sides: list[Candidates]) -> np.ndarray:
    hinge = np.full(1, scene.hinge_rad) if scene.model.is_articulated else None
    centre = scene.upright @ body_motion(scene.model, np.eye(3)[None], np.zeros((1, 3)), hinge).centre_m[0]
    contacts = [capsule_contacts(scene, side) for side in sides]
    apart = hand_gap_m(sides) > SMALLEST_HAND_GAP_M
    held = np.zeros(len(apart), dtype=bool)
    for row in np.flatnonzero(apart):
        points = np.concatenate([side[row][0] for side in contacts])
        normals = np.concatenate([side[row][1] for side in contacts])
        held[row] = closes_force(points, normals, centre)
    return held


def _for_subjects(scene: Scene, hold: Hold, placements, own: CapsuleHands, betas: np.ndarray, pair: HandPair):
    """For each placement: (subject,) scores and grips, closed again with every subject's hand."""
    n_subjects = len(betas)
    sides = [
        close_candidates(scene, side, placement.for_hands(n_subjects), own)
        for (side, _), placement in zip(hold.reaches, placements, strict=True)
    ]
    posed = [posed_hands(side, betas) for side in sides]
    score = verify(scene, hold, posed, pair)
    clear = np.all([clear_of_table(scene, side) for side in sides], axis=0) & (hand_gap_m(sides) > SMALLEST_HAND_GAP_M)
    score = np.where(clear, score, 0.0).reshape(-1, n_subjects)
    entries = []
    for index, scores in enumerate(score):
        grips = [
            tuple(
                to_grip(scene, reach, hand, index * n_subjects + subject)
                for (_, reach), hand in zip(hold.reaches, posed, strict=True)
            )
            if scores[subject] > 0
            else None
            for subject in range(n_subjects)
        ]
        entries.append((scores, grips))
    return entries
