"""The field table as hoidata/store/README.md: ``python -m hoidata.store_check.describe > hoidata/store/README.md``."""

from hoidata.store.fields import SCHEMA_VERSION, STORE_FILES, Field, StoreFile

_HEAD = f"""# The store, schema {SCHEMA_VERSION}

A store is a folder with the clips of one dataset: Parquet tables in `meta/`, stored (never compressed) NPZ files in
`arrays/`. Any tool that reads Parquet and NPZ reads it; `hoidata.store.store.open_store(folder).clip(id)` puts a clip
together. `hoidata info STORE` describes one, and `hoidata validate STORE` checks it against the tables
below. This file is generated from `fields.py`, which the writer and the checker use, by
`python -m hoidata.store_check.describe`; a test keeps it equal.

## Conventions
- Metres, radians, seconds, 30 frames per second, column vectors, axis-angle rotations (rotation vectors).
- World frame: the source's own, made right-handed. `source_from_world` leads back to its frame and unit.
- A hand's place is its wrist joint in the world, never MANO's `transl`; finger poses are absolute: zero is flat.
- Object frame: that of the mesh, hinge at zero. A hinge turns part 1 by `R(axis * angle)` about its origin.
- Every number is finite, also where `<side>_valid` is False. `null` and -1 stand only where the tables say so.

## How rows belong to clips
The clips of a shard follow one another in the order of `sequences.parquet`, without gaps. A clip's frames are the rows
`first_row` to `first_row + n_frames` of every member that counts frames. Betas start at `<side>_betas_row` and have 1
row or one per frame (`<side>_betas_count`). Further object k starts at `other_row + k * n_frames`. Camera, body and
expression have `n_frames` rows from their own `*_row`; contact labels have `source_contact_count` rows.

## Ids, names and order
- `clip_id` is made from the source's own names and frame numbers, never from a place in a list: a dataset of which a
  part is missing gives the same ids, arrays and rows for what is there. Only the numbers that point elsewhere move
  (`shard`, `*_row`, `source_files`).
- A second clip under an id that is taken is left out, with a row in `quarantine.parquet`; the first in writing order
  stays. A conversion writes in the order of the sequence keys, whatever the number of processes.
- An object's key is its name. Where a store has different meshes under one name, all of them are called
  `<name>#<first 8 digits of digest>`; which came first does not matter. So this key, unlike clip ids, can change when
  the sequences with the other mesh are missing; `digest` never does.

## Versions
A store of another `schema_version` is refused: convert its raw files again.
"""


def readme() -> str:
    """The text of README.md."""
    return "\n".join([_HEAD, *(_section(file) for file in STORE_FILES)])


def _section(file: StoreFile) -> str:
    lines = [f"## `{file.path}`", f"{file.meaning[0].upper()}{file.meaning[1:]}. Order: {file.order}.", ""]
    lines.append("| name | dtype | shape | axes | unit | frame | required | meaning |")
    lines.append("|---|---|---|---|---|---|---|---|")
    return "\n".join([*lines, *(_row(field) for field in file.fields), ""])


def _row(field: Field) -> str:
    choices = f" ({', '.join(field.choices)})" if field.choices else ""
    cells = (
        f"`{field.name}`",
        field.dtype,
        " x ".join(str(length) for length in field.shape) or "1",
        ", ".join(field.axes) or "-",
        field.unit or "-",
        field.frame or "-",
        "yes" if field.required else "or null",
        f"{field.meaning}{choices}",
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    print(readme(), end="")
