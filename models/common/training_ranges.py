"""What a checkpoint stores about the motions of its training clips: usual ranges of each verb, and which way is up."""

from typing import Any

from hoidata.actions.action import Actions
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import Clip
from hoidata.hands import HandPair
from hoidata.metrics import verdict
from hoidata.metrics.unmeasured import Unmeasured
from hoidata.metrics.verb_ranges import VerbRanges, training_ranges
from hoidata.metrics.verdict import RequestedVerb
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import Checkpoint

ACTIONS, OBJECT_UPS = "actions", "object_ups"  # among the results of a checkpoint


def ranges_record(annotated: AnnotatedStore) -> dict[str, Any]:
    """What training stores."""
    return {ACTIONS: training_ranges(annotated).record, OBJECT_UPS: verdict.object_ups(annotated)}


def verb_ranges(checkpoint: Checkpoint, hands: HandPair) -> VerbRanges | None:
    """The usual ranges of a checkpoint's training clips; None if it has none."""
    record, facts = checkpoint.info.get("results", {}).get(ACTIONS), checkpoint.facts
    return None if record is None else VerbRanges(Actions.read(record), facts["contact_threshold_m"], hands)


def object_ups(checkpoint: Checkpoint) -> dict[str, list[float]]:
    """Direction (3,) of each training object that is up in its first frames, object frame; empty if it has none."""
    return checkpoint.info.get("results", {}).get(OBJECT_UPS, {})


def requested_verb(
    checkpoint: Checkpoint, hands: HandPair, verb: str | None, clip: Clip, points: ObjectPoints
) -> RequestedVerb | Unmeasured:
    """The verb that a motion must show, or why it cannot be checked."""
    ranges = verb_ranges(checkpoint, hands)
    if ranges is None:
        return Unmeasured("the checkpoint has no ranges of its training clips")
    if verb is None or verb not in Vocabulary.read(checkpoint.facts).verbs:
        return Unmeasured("the sentence has no verb of the training clips")
    return RequestedVerb(verb, ranges, ranges.numbers(clip, points))
