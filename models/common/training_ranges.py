"""What a checkpoint stores about the motions of its training clips: usual ranges of each verb, and which way is up."""

from typing import Any

from hoidata.actions.action import Actions
from hoidata.hands import HandPair
from hoidata.metrics import verb_ranges as measures
from hoidata.metrics.verb_ranges import VerbRanges
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import Checkpoint

ACTIONS, OBJECT_UPS = "actions", "object_ups"  # among the results of a checkpoint


def ranges_record(annotated: AnnotatedStore) -> dict[str, Any]:
    """What training stores."""
    return {ACTIONS: measures.training_ranges(annotated).record, OBJECT_UPS: measures.object_ups(annotated)}


def verb_ranges(checkpoint: Checkpoint, hands: HandPair) -> VerbRanges | None:
    """The usual ranges of a checkpoint's training clips; None if it has none."""
    record, facts = checkpoint.info.get("results", {}).get(ACTIONS), checkpoint.facts
    return None if record is None else VerbRanges(Actions.read(record), facts["contact_threshold_m"], hands)


def object_ups(checkpoint: Checkpoint) -> dict[str, list[float]]:
    """Direction (3,) of each training object that is up in its first frames, object frame; empty if it has none."""
    return checkpoint.info.get("results", {}).get(OBJECT_UPS, {})
