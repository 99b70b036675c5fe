"""The field table as hoidata/store/README.md: ``python -m hoidata.store_check.describe > hoidata/store/README.md``."""

from dataclasses import replace

from hoidata.store.fields import SCHEMA_VERSION, STORE_FILES, Field, StoreFile

_HEAD = f"""# The store, schema {SCHEMA_VERSION}

A store is a folder with the clips of one dataset: Parquet tables in `meta/`, uncompressed NPZ files in `arrays/`.
`hoidata.store.store.open_store(folder).clip(id)` reads a clip, `hoidata info STORE` describes a store, `hoidata
validate STORE` checks it against the tables below. `python -m hoidata.store_check.describe` generates this page
from `fields.py`, which the writer and the checker use.

## Conventions
- Metres, radians, seconds, 30 frames per second, column vectors, rotation vectors (axis-angle).
- World: the frame of the source, made right-handed. `source_from_world` maps back to the source's frame and unit.
- A hand's position is its wrist joint in the world, never MANO's `transl`. Finger poses are absolute: zero is the
  flat hand.
- Object frame: the frame of the mesh, hinge at zero. A hinge rotates part 1 by `R(axis * angle)` about its origin. A
  prismatic joint moves it by `axis * displacement`.
- Every number is finite, also where `<side>_valid` is False.

## Rows of a clip
The clips of a shard are stored in the order of `sequences.parquet`, without gaps. A clip's frames are the rows
`first_row` to `first_row + n_frames` of every per-frame array. Betas start at `<side>_betas_row` and have
`<side>_betas_count` rows: 1, or one per frame. Further object k starts at `other_row + k * n_frames`. Camera, body
and expression start at their `*_row`; contact labels have `source_contact_count` rows.

## Ids and order
- `clip_id` consists of the source's names and frame numbers. A partial copy of a dataset gives the same ids, arrays
  and rows for the clips it has, except `shard`, `*_row` and `source_files`.
- A second clip with the same id is quarantined. Sequences are written in key order, whatever the number of processes.
- An object's key is its name. If meshes of one name differ, each is called `<name>#<first 8 digits of
  digest>`.

A store of another schema version is refused: convert its raw files again.

`<side>` is `left` and `right`. A shape names the axes of an array; one value has none. Values may be null only where
stated.
"""


def readme() -> str:
    """The text of README.md."""
    return "\n".join([_HEAD, *(_section(file) for file in STORE_FILES)])


def _section(file: StoreFile) -> str:
    lines = [f"## `{file.path}`", f"{file.meaning[0].upper()}{file.meaning[1:]}. Order: {file.order}.", ""]
    lines += ["| name | type | unit, frame | meaning |", "|---|---|---|---|"]
    paired = {f.name.replace("right_", "<side>_", 1) for f in file.fields if f.name.startswith("right_")}
    for field in file.fields:
        name = field.name.replace("left_", "<side>_", 1)
        if name in paired:
            lines.append(_row(replace(field, name=name, meaning=field.meaning.replace("left", "<side>"))))
        elif not field.name.startswith("right_"):
            lines.append(_row(field))
    return "\n".join([*lines, ""])


def _row(field: Field) -> str:
    shape = f" ({', '.join(str(length) for length in field.shape)})" if field.shape else ""
    choices = f" ({', '.join(field.choices)})" if field.choices else ""
    null = "" if field.required else "; may be null"
    unit_and_frame = ", ".join(filter(None, (field.unit, field.frame)))
    return f"| `{field.name}` | {field.dtype}{shape} | {unit_and_frame} | {field.meaning}{choices}{null} |"


if __name__ == "__main__":
    print(readme(), end="")
