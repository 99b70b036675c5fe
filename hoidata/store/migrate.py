"""Rewriting a store of an earlier schema version in today's."""

from collections.abc import Iterator
from pathlib import Path

from hoidata.clips.clip import Clip
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording
from hoidata.errors import BadInput
from hoidata.store.fields import SCHEMA_VERSION, parse_version
from hoidata.store.store import Store, open_store, read_info
from hoidata.store.versions import CURRENT
from hoidata.store.writing import write_store


def migrate_store(folder: str | Path) -> str:
    """Rewrite the store ``folder`` in today's schema, whole or not at all; the version it had.

    Ids, order, arrays and the list of what was left out stay; facts that the old version did not record are written as
    unknown. A store of today's version, or of a later minor one, is left as it is. Raises what ``open_store`` raises,
    and BadInput for a major version that has no migration.
    """
    found = str(read_info(folder)["schema_version"])
    if found.split(".")[0] == "0":
        expected, remedy = "schema version 1.0.0 or later", "no release wrote it: run the conversion again"
        raise BadInput(Path(folder) / "meta" / "info.json", expected, found, remedy)
    store = open_store(folder)
    if parse_version(found) < CURRENT:
        write_store(folder, _contents(store), store.info)
    return found


def is_current(version: str) -> bool:
    return parse_version(version) >= parse_version(SCHEMA_VERSION)


def _contents(store: Store) -> Iterator[Clip | HandRecording | Quarantined]:
    for row in store.quarantine.to_dict("records"):
        yield Quarantined(**{str(key): value for key, value in row.items()})
    for clip_id in store.ids:
        yield store.clip(clip_id)
    for sequence in store.recordings:
        yield store.recording(sequence)
